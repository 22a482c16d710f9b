//! The ground agent on the vehicle's MAVLink network.

use super::Station;
use super::config::{MavlinkConfig, Uav};
use serde::Serialize;
use std::sync::Arc;

/// How the MAVLink side fares, for `/health`.
#[derive(Debug, Clone, Serialize)]
pub(super) struct LinkHealth {
    url: String,
}

pub(super) async fn run(station: Arc<Station>, config: MavlinkConfig, _uavs: Vec<Uav>) {
    *super::lock(&station.mavlink) = Some(LinkHealth { url: config.url });
}
