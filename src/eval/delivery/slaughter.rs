//! Random SIGKILLs of either side in wild weather; and beside it, in a fleet of its own, the outage.

use super::audit::compare;
use super::children::{Aircraft, Behaviour, Ground, Way};
use super::proxy::{Proxy, Weather};
use super::{Audit, DeliveryError, Found, Options, Told, outage};
use crate::eval::Table;
use emberfix_report::{Bound, Figure};
use rand::{Rng as _, SeedableRng as _};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Kills of a whole run, and of a small one.
pub const KILLS: (usize, usize) = (1_000, 30);
/// Pairs of an aircraft and a ground that are killed at the same time.
const PAIRS: usize = 3;
/// A life lasts this long, evenly, milliseconds; some are over before the first alarm.
const LIFE_MS: std::ops::Range<u64> = 10..700;
/// After the last kill, in good weather.
const DRAIN: Duration = Duration::from_secs(60);

pub(super) fn measure(
    options: &Options,
    scratch: &Path,
    told: Told<'_>,
) -> Result<Found, DeliveryError> {
    let wanted = if options.quick { KILLS.1 } else { KILLS.0 };
    let kills = AtomicUsize::new(0);
    let (pairs, outage) = std::thread::scope(|scope| {
        let pairs: Vec<_> = (0..PAIRS)
            .map(|pair| {
                let kills = &kills;
                let folder = scratch.join(format!("pair-{pair}"));
                let seed = options.seed + 100 * (pair as u64 + 1);
                scope.spawn(move || run(seed, &folder, &|| strike(kills, wanted, told)))
            })
            .collect();
        let outage = scope.spawn(|| outage::measure(options, &scratch.join("outage")));
        let joined = |thread: std::thread::ScopedJoinHandle<'_, _>| {
            thread.join().unwrap_or(Err(DeliveryError::Thread))
        };
        let pairs: Vec<Result<Killed, DeliveryError>> = pairs.into_iter().map(joined).collect();
        (pairs, outage.join().unwrap_or(Err(DeliveryError::Thread)))
    });
    let pairs = pairs.into_iter().collect::<Result<Vec<_>, _>>()?;
    let mut found = outage?;
    let audit = pairs
        .iter()
        .fold(Audit::default(), |sum, pair| sum.plus(pair.audit));
    found.audit = found.audit.plus(audit);
    let done: usize = pairs.iter().map(|pair| pair.aircraft + pair.ground).sum();
    found.figures.insert(
        0,
        Figure::bounded(
            "delivery.kills",
            Some(done as f64),
            "kills",
            Bound::AtLeast(KILLS.0 as f64),
            done,
        ),
    );
    found.tables.push(table(&pairs));
    Ok(found)
}

/// True while there is another kill to do.
fn strike(kills: &AtomicUsize, wanted: usize, told: Told<'_>) -> bool {
    let mine = kills.fetch_add(1, Ordering::Relaxed);
    if mine < wanted {
        told("kills");
    }
    mine < wanted
}

struct Killed {
    aircraft: usize,
    ground: usize,
    audit: Audit,
    landed: bool,
}

fn run(seed: u64, folder: &Path, another: &dyn Fn() -> bool) -> Result<Killed, DeliveryError> {
    const UAV: &str = "uav-1";
    let home = folder.join("uav");
    let key = Aircraft::key(&home)?;
    let mut ground = Ground::start(folder, &[(UAV.to_owned(), key)])?;
    let proxy = Proxy::start(ground.address, Weather::wild(), seed)?;
    let behaviour = Behaviour {
        uav: UAV.to_owned(),
        every_ms: 25,
        revisions: 0.4,
        way: Way::Datagrams,
    };
    let mut aircraft = Aircraft::start(&home, behaviour, proxy.address, ground.key)?;
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut killed = Killed {
        aircraft: 0,
        ground: 0,
        audit: Audit::default(),
        landed: false,
    };
    while another() {
        std::thread::sleep(Duration::from_millis(random.random_range(LIFE_MS)));
        if random.random_bool(0.5) {
            aircraft.restart()?;
            killed.aircraft += 1;
        } else {
            ground.restart()?;
            killed.ground += 1;
        }
    }
    proxy.set(Weather::good());
    killed.landed = aircraft.land(DRAIN)?;
    let outbox = Aircraft::database(&home);
    killed.audit = compare(&outbox, &ground.database(), UAV, &aircraft.said())?;
    Ok(killed)
}

fn table(pairs: &[Killed]) -> Table {
    let row = |(pair, killed): (usize, &Killed)| {
        vec![
            (pair + 1).to_string(),
            killed.aircraft.to_string(),
            killed.ground.to_string(),
            killed.audit.put.to_string(),
            killed.audit.lost.to_string(),
            killed.audit.duplicated.to_string(),
            if killed.landed { "yes" } else { "no" }.to_owned(),
        ]
    };
    Table {
        title: "Kills, with 30 % loss, 40 to 100 ms each way, out of order, 10 % twice".to_owned(),
        header: [
            "pair",
            "aircraft killed",
            "ground killed",
            "alarms",
            "lost",
            "duplicated",
            "outbox empty in the end",
        ]
        .map(str::to_owned)
        .to_vec(),
        rows: pairs.iter().enumerate().map(row).collect(),
    }
}
