//! `ADSB_VEHICLE`: the one message that every stock ground station program draws on its map.
//!
//! **Never towards an autopilot**: PX4 takes what it says for traffic, and may turn back or land
//! (`NAV_TRAFF_AVOID`). It is for a link that ends at a ground station program.

use crate::outgoing::{MavMessage, degrees_e7};
use emberfix_frames::MslAltitude;
use mavlink::dialects::development as dialect;
use mavlink::types::CharArray;

/// Something that stands still and wants to be seen.
#[derive(Debug, Clone, PartialEq)]
pub struct TrafficMarker {
    /// 24 bits; programs tell markers apart by it.
    pub icao_address: u32,
    /// Up to eight characters are shown.
    pub callsign: String,
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// Above mean sea level.
    pub altitude: MslAltitude,
}

/// The marker as a message: a point obstacle, marked as simulated, because no aircraft is there.
#[must_use]
pub fn traffic_marker(marker: &TrafficMarker) -> MavMessage {
    use dialect::AdsbFlags;
    let mut callsign = [0; 9];
    for (place, byte) in callsign.iter_mut().take(8).zip(marker.callsign.bytes()) {
        *place = byte;
    }
    MavMessage::ADSB_VEHICLE(dialect::ADSB_VEHICLE_DATA {
        ICAO_address: marker.icao_address & 0x00ff_ffff,
        lat: degrees_e7(marker.latitude_deg),
        lon: degrees_e7(marker.longitude_deg),
        // Saturates, as casts from float do.
        altitude: (marker.altitude.m() * 1e3).round() as i32,
        altitude_type: dialect::AdsbAltitudeType::ADSB_ALTITUDE_TYPE_GEOMETRIC,
        emitter_type: dialect::AdsbEmitterType::ADSB_EMITTER_TYPE_POINT_OBSTACLE,
        flags: AdsbFlags::ADSB_FLAGS_VALID_COORDS
            | AdsbFlags::ADSB_FLAGS_VALID_ALTITUDE
            | AdsbFlags::ADSB_FLAGS_VALID_CALLSIGN
            | AdsbFlags::ADSB_FLAGS_SIMULATED,
        callsign: CharArray::new(callsign),
        ..dialect::ADSB_VEHICLE_DATA::DEFAULT
    })
}
