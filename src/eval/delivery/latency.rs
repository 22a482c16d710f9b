//! Milliseconds from decision to the ground's disk.

use super::audit::{Watch, compare};
use super::children::{Aircraft, Behaviour, Ground, Way};
use super::proxy::{Proxy, Weather};
use super::quic::{Congestion, Relay};
use super::{DeliveryError, Found, Options, Told};
use crate::eval::Table;
use emberfix_report::{Bound, Figure};
use std::collections::HashMap;
use std::path::Path;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

const UAV: &str = "uav-1";
/// Between two looks at the ground's database.
const LOOK: Duration = Duration::from_millis(2);
/// After the last alarm was put.
const DRAIN: Duration = Duration::from_secs(120);

/// One way to measure.
struct Case {
    name: &'static str,
    weather: Weather,
    link: Link,
    every_ms: u64,
    alarms: usize,
}

#[derive(Clone, Copy)]
enum Link {
    Datagrams,
    Http,
    Quic(Congestion),
}

/// How many there are.
pub(super) const CASES: usize = 7;

/// Latencies of one case, in milliseconds, sorted; and its audit.
struct Measured {
    ms: Vec<f64>,
    audit: super::Audit,
}

impl Measured {
    fn percentile(&self, percent: usize) -> Option<f64> {
        let at = (self.ms.len() * percent).div_ceil(100).checked_sub(1)?;
        self.ms.get(at).copied()
    }
}

pub(super) fn measure(
    options: &Options,
    scratch: &Path,
    told: Told<'_>,
) -> Result<Found, DeliveryError> {
    let mut found = Found::default();
    let mut rows = Vec::new();
    for case in cases(options.quick) {
        told(case.name);
        let measured = run(&case, options.seed, &scratch.join(case.name))?;
        found.audit = found.audit.plus(measured.audit);
        rows.push(row(&case, &measured));
        found.figures.push(figure(&case, &measured));
        found.details.insert(
            format!("latency_{}_ms", case.name),
            [50, 90, 95, 99, 100]
                .map(|p| measured.percentile(p))
                .to_vec()
                .into(),
        );
    }
    found.tables.push(Table {
        title:
            "Decision to the ground's disk, ms (40 ms each way and 30 % lost where it is lossy; TCP's \
             loss is modelled)"
                .to_owned(),
        header: ["case", "every ms", "alarms", "p50", "p90", "p95", "p99", "max"]
            .map(str::to_owned)
            .to_vec(),
        rows,
    });
    Ok(found)
}

fn cases(quick: bool) -> Vec<Case> {
    let (good, lossy) = (Weather::good(), Weather::lossy());
    let alarms = |whole: usize| if quick { whole / 10 } else { whole };
    let case = |name, weather, link, every_ms, whole| Case {
        name,
        weather,
        link,
        every_ms,
        alarms: alarms(whole),
    };
    vec![
        case("good", good, Link::Datagrams, 40, 500),
        case("lossy", lossy, Link::Datagrams, 40, 2_000),
        case("good_http", good, Link::Http, 60, 300),
        case("lossy_http", lossy, Link::Http, 120, 400),
        case("good_quic", good, Link::Quic(Congestion::Cubic), 60, 300),
        case("lossy_quic", lossy, Link::Quic(Congestion::Cubic), 120, 400),
        case(
            "lossy_quic_bbr",
            lossy,
            Link::Quic(Congestion::Bbr),
            120,
            400,
        ),
    ]
}

fn figure(case: &Case, measured: &Measured) -> Figure {
    let n = measured.ms.len();
    let floor_ms = 2.0 * case.weather.delay.as_secs_f64() * 1e3;
    let (p95, p99) = (measured.percentile(95), measured.percentile(99));
    match case.name {
        "good" => Figure::bounded(
            "delivery.good_link_p95_ms",
            p95,
            "ms",
            Bound::AtMost(500.0),
            n,
        ),
        // What is beyond the way there and back.
        "lossy" => Figure::bounded(
            "delivery.lossy_link_p99_ms",
            p99.map(|p99| p99 - floor_ms),
            "ms",
            Bound::AtMost(350.0),
            n,
        ),
        "good_http" => Figure::told("delivery.good_link_http_p95_ms", p95, "ms", n),
        "good_quic" => Figure::told("delivery.good_link_quic_p95_ms", p95, "ms", n),
        _ => Figure::told(
            match case.link {
                Link::Quic(Congestion::Cubic) => "delivery.lossy_link_quic_p99_ms",
                Link::Quic(Congestion::Bbr) => "delivery.lossy_link_quic_bbr_p99_ms",
                Link::Http | Link::Datagrams => "delivery.lossy_link_http_p99_ms",
            },
            p99.map(|p99| p99 - floor_ms),
            "ms",
            n,
        ),
    }
}

fn row(case: &Case, measured: &Measured) -> Vec<String> {
    let ms = |percent| {
        measured
            .percentile(percent)
            .map_or_else(String::new, |ms| format!("{ms:.0}"))
    };
    let percentiles = [50, 90, 95, 99, 100].map(ms);
    let counts = [case.every_ms.to_string(), measured.ms.len().to_string()];
    std::iter::once(case.name.to_owned())
        .chain(counts)
        .chain(percentiles)
        .collect()
}

fn run(case: &Case, seed: u64, folder: &Path) -> Result<Measured, DeliveryError> {
    let home = folder.join("uav");
    let key = Aircraft::key(&home)?;
    let ground = Ground::start(folder, &[(UAV.to_owned(), key)])?;
    let relay = match case.link {
        Link::Quic(_) => Some(Relay::start(ground.address, folder)?),
        Link::Datagrams | Link::Http => None,
    };
    let behind = relay.as_ref().map_or(ground.address, |relay| relay.address);
    let proxy = Proxy::start(behind, case.weather, seed)?;
    let way = match (case.link, &relay) {
        (Link::Quic(congestion), Some(relay)) => Way::Quic(relay.certificate.clone(), congestion),
        (Link::Http, _) => Way::Http,
        _ => Way::Datagrams,
    };
    let behaviour = Behaviour {
        uav: UAV.to_owned(),
        every_ms: case.every_ms,
        revisions: 0.0,
        way,
    };
    let mut watch = Watch::open(&ground.database())?;
    let mut aircraft = Aircraft::start(&home, behaviour, proxy.address, ground.key)?;
    let mut came: HashMap<String, i64> = HashMap::new();
    let begun = Instant::now();
    let flight =
        Duration::from_millis(case.every_ms) * u32::try_from(case.alarms).unwrap_or(u32::MAX);
    while begun.elapsed() < flight {
        look(&mut watch, &mut came);
    }
    let landing = std::thread::spawn(move || {
        let landed = aircraft.land(DRAIN);
        (aircraft, landed)
    });
    while !landing.is_finished() {
        look(&mut watch, &mut came);
    }
    let (aircraft, landed) = landing.join().map_err(|_| DeliveryError::Thread)?;
    landed?;
    look(&mut watch, &mut came);
    let puts = aircraft.puts();
    let mut ms: Vec<f64> = puts
        .iter()
        .filter_map(|put| Some((came.get(&put.id)? - put.decided_ns) as f64 / 1e6))
        .collect();
    ms.sort_by(f64::total_cmp);
    let database = Aircraft::database(&home);
    let audit = compare(&database, &ground.database(), UAV, &aircraft.said())?;
    Ok(Measured { ms, audit })
}

fn look(watch: &mut Watch, came: &mut HashMap<String, i64>) {
    for (id, _) in watch.look() {
        came.entry(id).or_insert_with(unix_ns);
    }
    std::thread::sleep(LOOK);
}

pub(super) fn unix_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    i64::try_from(since.unwrap_or_default().as_nanos()).unwrap_or(i64::MAX)
}
