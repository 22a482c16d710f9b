//! A long outage, really waited for, and how quickly everything is there after it.

use super::audit::{Watch, compare};
use super::children::{Aircraft, Behaviour, Ground, Put, Way};
use super::proxy::{Proxy, Weather};
use super::{DeliveryError, Found, Options};
use emberfix_report::{Bound, Figure};
use std::collections::HashMap;
use std::path::Path;
use std::time::{Duration, Instant};

const UAV: &str = "uav-1";
/// How long nothing passes: whole, and in a small run.
const OUTAGE: (Duration, Duration) = (Duration::from_secs(600), Duration::from_secs(20));
/// Before it, everything passes.
const BEFORE: Duration = Duration::from_secs(3);
/// After it, at most.
const DRAIN: Duration = Duration::from_secs(60);

pub(super) fn measure(options: &Options, folder: &Path) -> Result<Found, DeliveryError> {
    let outage = if options.quick { OUTAGE.1 } else { OUTAGE.0 };
    let home = folder.join("uav");
    let key = Aircraft::key(&home)?;
    let ground = Ground::start(folder, &[(UAV.to_owned(), key)])?;
    let proxy = Proxy::start(ground.address, Weather::good(), options.seed)?;
    let behaviour = Behaviour {
        uav: UAV.to_owned(),
        every_ms: 2_000,
        revisions: 0.3,
        way: Way::Datagrams,
    };
    let mut aircraft = Aircraft::start(&home, behaviour, proxy.address, ground.key)?;
    std::thread::sleep(BEFORE);
    proxy.set(Weather {
        cut: true,
        ..Weather::good()
    });
    std::thread::sleep(outage);
    let owed = newest(&aircraft.puts());
    let mut watch = Watch::open(&ground.database())?;
    let before = there(&mut watch, HashMap::new(), &owed);
    proxy.set(Weather::good());
    let drained = drain(&mut watch, before.0, &owed);
    aircraft.land(DRAIN)?;
    let outbox = Aircraft::database(&home);
    let audit = compare(&outbox, &ground.database(), UAV, &aircraft.said())?;
    let mut found = Found {
        audit,
        ..Found::default()
    };
    let waited = owed.len() - before.1;
    found.figures.push(Figure::bounded(
        "delivery.drain_s",
        drained.map(|took| took.as_secs_f64()),
        "s",
        Bound::AtMost(2.0),
        waited,
    ));
    found
        .details
        .insert("outage_s".to_owned(), outage.as_secs().into());
    Ok(found)
}

type Newest = HashMap<String, u32>;

fn newest(puts: &[Put]) -> Newest {
    let mut newest = Newest::new();
    for put in puts {
        let known = newest.entry(put.id.clone()).or_default();
        *known = (*known).max(put.revision);
    }
    newest
}

/// What has come by now, and how many of those that are owed.
fn there(watch: &mut Watch, mut came: Newest, owed: &Newest) -> (Newest, usize) {
    for (id, revision) in watch.look() {
        let known = came.entry(id).or_default();
        *known = (*known).max(revision);
    }
    let has =
        |(id, revision): &(&String, &u32)| came.get(*id).is_some_and(|there| there >= *revision);
    let count = owed.iter().filter(has).count();
    (came, count)
}

fn drain(watch: &mut Watch, mut came: Newest, owed: &Newest) -> Option<Duration> {
    let begun = Instant::now();
    while begun.elapsed() < DRAIN {
        let (now, count) = there(watch, came, owed);
        if count == owed.len() {
            return Some(begun.elapsed());
        }
        came = now;
        std::thread::sleep(Duration::from_millis(2));
    }
    None
}
