//! A live view for Foxglove: incidents as GeoJSON and as fixes with covariance, aircraft as fixes.
//!
//! **Queue.** Foxglove's own, [`QUEUED`] messages for each client, the oldest dropped; each message
//! holds everything, so the next one makes good for it.

use super::view;
use crate::ground::Ping;
use crate::ground::incident::Incident;
use emberfix_frames::ServiceTime;
use foxglove::messages::location_fix::PositionCovarianceType;
use foxglove::messages::{GeoJson, LocationFix, LocationFixes, Timestamp};
use foxglove::{Channel, Context, FoxgloveError, WebSocketServer};
use std::net::SocketAddr;
use std::sync::Arc;

/// Messages that wait for one slow client.
const QUEUED: usize = 64;
/// Corners of an ellipse.
const CORNERS: u32 = 36;

/// The server and its channels. Dropped, it stops.
#[derive(Debug)]
pub(super) struct Foxglove {
    server: Option<foxglove::WebSocketServerHandle>,
    /// Channels close with it.
    _context: Arc<Context>,
    geojson: Channel<GeoJson>,
    fires: Channel<LocationFixes>,
    aircraft: Channel<LocationFixes>,
}

impl Foxglove {
    /// Listens.
    pub(super) async fn start(listen: SocketAddr) -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let server = WebSocketServer::new()
            .name(concat!("emberfix ground ", env!("CARGO_PKG_VERSION")))
            .context(&context)
            .message_backlog_size(QUEUED)
            .bind(listen.ip().to_string(), listen.port());
        Ok(Self {
            geojson: context.channel_builder("/fire/incidents/geojson").build(),
            fires: context.channel_builder("/fire/incidents").build(),
            aircraft: context.channel_builder("/uav/fixes").build(),
            server: Some(server.start().await?),
            _context: context,
        })
    }

    /// Says how everything stands.
    pub(super) fn show(&self, incidents: &[Arc<Incident>], aircraft: &[Ping]) {
        let shown = || {
            incidents
                .iter()
                .map(AsRef::as_ref)
                .filter(|incident| view::is_shown(incident))
        };
        self.geojson.log(&GeoJson {
            geojson: features(shown()),
        });
        self.fires.log(&LocationFixes {
            fixes: shown().map(fire).collect(),
        });
        self.aircraft.log(&LocationFixes {
            fixes: aircraft.iter().map(craft).collect(),
        });
    }
}

impl Drop for Foxglove {
    fn drop(&mut self) {
        if let Some(server) = self.server.take() {
            // Its clients are told to go; there is nothing to wait for.
            drop(server.stop());
        }
    }
}

/// The map panel draws points and polygons, and shows the properties.
fn features<'i>(incidents: impl Iterator<Item = &'i Incident>) -> String {
    let features: Vec<_> = incidents
        .flat_map(|incident| [feature(incident), ellipse(incident)])
        .collect();
    serde_json::json!({ "type": "FeatureCollection", "features": features }).to_string()
}

fn feature(incident: &Incident) -> serde_json::Value {
    let mut feature = incident.to_geojson();
    feature["properties"]["name"] = view::callsign(incident).into();
    feature["properties"]["style"] = serde_json::json!({ "color": "#b3260e" });
    feature
}

fn ellipse(incident: &Incident) -> serde_json::Value {
    let rings = view::ellipse90(incident, CORNERS);
    let geometry = match rings.as_slice() {
        [ring] => serde_json::json!({ "type": "Polygon", "coordinates": [ring] }),
        rings => {
            let polygons: Vec<_> = rings.iter().map(|ring| [ring]).collect();
            serde_json::json!({ "type": "MultiPolygon", "coordinates": polygons })
        }
    };
    serde_json::json!({
        "type": "Feature",
        "geometry": geometry,
        "properties": {
            "name": format!("{}: 90 % ellipse", view::callsign(incident)),
            "style": { "color": "#b3260e", "opacity": 0.4 },
        },
    })
}

fn fire(incident: &Incident) -> LocationFix {
    let [longitude, latitude, altitude] = incident.coordinates();
    LocationFix {
        timestamp: Some(timestamp(incident.captured_at)),
        frame_id: incident.id.clone(),
        latitude,
        longitude,
        altitude,
        position_covariance: incident.covariance_enu_m2.to_vec(),
        position_covariance_type: PositionCovarianceType::Known.into(),
        ..LocationFix::default()
    }
}

fn craft(ping: &Ping) -> LocationFix {
    LocationFix {
        timestamp: Some(timestamp(ping.at)),
        frame_id: ping.uav.clone(),
        latitude: ping.latitude_deg,
        longitude: ping.longitude_deg,
        altitude: ping.height_ellipsoid_m,
        heading: ping.heading_deg.map(f64::to_radians),
        ..LocationFix::default()
    }
}

fn timestamp(at: ServiceTime) -> Timestamp {
    let ns = at.unix_ns_u64();
    let second = u32::try_from(ns / 1_000_000_000).unwrap_or(u32::MAX);
    Timestamp::new(second, (ns % 1_000_000_000) as u32)
}
