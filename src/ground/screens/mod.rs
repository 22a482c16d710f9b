//! The screens: every picture of the incidents that programs other than our page understand.
//!
//! **In.** Incidents and aircraft as the station has them. **Out.** KML (`/emberfix.kml`), CAP 1.2
//! (`/cap.atom`), Cursor on Target over multicast, TCP and TLS, a marker for MAVLink ground station
//! programs, Prometheus (`/metrics`), a Foxglove live view. Each is a pure function from an
//! [`Incident`] to bytes, in a file of its own; this file feeds them.
//!
//! **Bound.** One list of incidents, newest first, made anew at most every [`LEAST`]; who is slow misses
//! a list and takes the next.

mod adsb;
mod cap;
pub(super) mod config;
mod cot;
mod foxglove;
mod issuer;
mod kml;
mod metrics;
mod rings;
mod routes;
mod tak;
#[cfg(test)]
mod tests;
mod tiles;
mod told;
mod view;
mod xml;

pub use issuer::CapError;
pub(super) use routes::routes;
pub use tak::TakError;

use self::config::ScreensConfig;
use self::issuer::Issuer;
use self::tak::Tak;
use self::tiles::MapConfig;
use super::{GroundError, Incident, Ping, Station, now};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};

/// All that stand, the one that changed last first.
pub(super) type Incidents = Arc<[Arc<Incident>]>;

/// The list is made anew at most this often, however many alarms come.
const LEAST: Duration = Duration::from_millis(200);
/// And at least this often, for what changes with time alone.
const MOST: Duration = Duration::from_secs(2);

/// What the screens keep beside the station.
#[derive(Debug)]
pub(super) struct Screens {
    incidents: watch::Sender<Incidents>,
    cap: Option<Arc<Issuer>>,
    map: Option<MapConfig>,
    tak: Vec<(String, Arc<tak::Health>)>,
    adsb: Option<Arc<adsb::Health>>,
}

impl Screens {
    /// Opens what is on disk; starts nothing.
    pub(super) fn open(config: &ScreensConfig, data_dir: &Path) -> Result<Self, CapError> {
        let cap = config
            .cap
            .clone()
            .map(|cap| Issuer::open(cap, data_dir))
            .transpose()?;
        let tak = config
            .cot
            .iter()
            .map(|tak| (tak.endpoint.to_string(), Arc::default()))
            .collect();
        Ok(Self {
            incidents: watch::Sender::new(Arc::from([])),
            cap: cap.map(Arc::new),
            map: config.map.clone(),
            tak,
            adsb: config.adsb.as_ref().map(|_| Arc::default()),
        })
    }

    /// Where else the page may load pictures from.
    pub(super) fn tile_origin(&self) -> Option<&str> {
        self.map.as_ref().and_then(MapConfig::origin)
    }
}

/// Starts every screen that sends of its own accord.
pub(super) async fn start(
    station: &Arc<Station>,
    config: ScreensConfig,
) -> Result<(), GroundError> {
    let screens = &station.screens;
    for (tak, (_, health)) in config.cot.into_iter().zip(&screens.tak) {
        let tak = Tak::new(tak, screens.incidents.subscribe(), Arc::clone(health))?;
        tokio::spawn(until_stopped(Arc::clone(station), tak.run()));
    }
    if let (Some(adsb), Some(health)) = (config.adsb, &screens.adsb) {
        let link = emberfix_mav::Link::open(&adsb.url).await?;
        let run = adsb::run(
            adsb,
            link,
            screens.incidents.subscribe(),
            Arc::clone(health),
        );
        tokio::spawn(until_stopped(Arc::clone(station), run));
    }
    let foxglove = match config.foxglove {
        Some(listen) => Some(foxglove::Foxglove::start(listen).await?),
        None => None,
    };
    tokio::spawn(until_stopped(
        Arc::clone(station),
        keep_up(Arc::clone(station), foxglove),
    ));
    Ok(())
}

async fn until_stopped(station: Arc<Station>, work: impl Future<Output = ()>) {
    let mut stopping = station.stopping.subscribe();
    tokio::select! {
        () = work => {}
        _ = stopping.wait_for(|stop| *stop) => {}
    }
}

/// Makes the list anew when something changed, and tells those that are fed from here.
async fn keep_up(station: Arc<Station>, foxglove: Option<foxglove::Foxglove>) {
    let mut rows = station.rows();
    loop {
        rows.mark_unchanged();
        show(&station, newest_first(&station), foxglove.as_ref()).await;
        sleep(LEAST).await;
        // Either way it is time to look.
        let _ = timeout(MOST, rows.changed()).await;
    }
}

fn newest_first(station: &Station) -> Incidents {
    let mut incidents = station.incidents();
    incidents.sort_by_key(|incident| std::cmp::Reverse(incident.row));
    incidents.into()
}

async fn show(station: &Arc<Station>, incidents: Incidents, foxglove: Option<&foxglove::Foxglove>) {
    if let Some(cap) = station.screens.cap.clone() {
        let (incidents, known) = (Arc::clone(&incidents), Arc::clone(station));
        let heir = move |id: &str| known.incident(id).filter(|heir| heir.id != id);
        let issued = tokio::task::spawn_blocking(move || cap.issue(&incidents, heir, now())).await;
        if let Ok(Err(error)) = issued {
            tracing::error!(%error, "no CAP message could be issued");
        }
    }
    if let Some(foxglove) = foxglove {
        foxglove.show(&incidents, &aircraft(station));
    }
    station.screens.incidents.send_if_modified(|known| {
        let is_news = known
            .iter()
            .map(|old| old.row)
            .ne(incidents.iter().map(|new| new.row));
        *known = incidents;
        is_news
    });
}

fn aircraft(station: &Station) -> Vec<Ping> {
    station.tracks().latest().cloned().collect()
}
