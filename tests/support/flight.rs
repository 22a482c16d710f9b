//! A vehicle whose place is known exactly, on the wire as PX4 would say it.

use emberfix_frames::{
    Attitude, BootTime, Coordinate, EllipsoidHeight, GeoidUndulation, Metres, ServiceTime,
    SignedDuration, Vector3, VehicleEnu, Wgs84, Wgs84Parts, ecef_from_enu, place_from_degrees,
    place_from_ecef,
};
use emberfix_mav::outgoing::{
    MavMessage, attitude_quaternion, autopilot_heartbeat, global_position, gps_raw, timesync,
};
use emberfix_mav::telemetry::{
    AttitudeSample, AttitudeSource, GlobalPosition, GnssFix, GnssPlace, GpsRaw, TimeSyncMessage,
    VehicleTime,
};
use emberfix_mav::{Address, Encoder};

/// Where the vehicle is and how it stands, in the tangent plane of the anchor.
#[derive(Debug, Clone, Copy)]
pub struct State {
    /// Metres east, north, up of the anchor.
    pub position_enu_m: Vector3<f64>,
    /// Metres per second north, east, down.
    pub velocity_ned_m_s: Vector3<f64>,
    /// Body to north, east, down.
    pub attitude: Attitude,
}

/// Encodes one vehicle's telemetry.
pub struct Vehicle {
    encoder: Encoder,
    anchor: Wgs84,
    undulation: GeoidUndulation,
    booted: ServiceTime,
}

/// From a message's moment to its arrival.
const TRANSPORT: SignedDuration = SignedDuration::from_millis(1);

impl Vehicle {
    /// System 1, whose boot clock was zero at `booted`; the anchor's height is above the ellipsoid.
    pub fn new(
        (latitude_deg, longitude_deg): (f64, f64),
        height: EllipsoidHeight,
        undulation: GeoidUndulation,
        booted: ServiceTime,
    ) -> Self {
        Self {
            encoder: Encoder::new(Address::new(1, 1)),
            anchor: place_from_degrees(latitude_deg, longitude_deg, height).unwrap(),
            undulation,
            booted,
        }
    }

    /// The place of a state.
    pub fn place(&self, state: &State) -> Wgs84 {
        let point = Coordinate::<VehicleEnu>::from_metres(state.position_enu_m);
        place_from_ecef(&ecef_from_enu(&self.anchor).transform(point)).unwrap()
    }

    /// Attitude and position at a moment, and when they arrive.
    pub fn pose(&mut self, at: ServiceTime, state: &State) -> [(ServiceTime, Vec<u8>); 2] {
        let attitude = attitude_quaternion(&AttitudeSample {
            boot: self.boot(at),
            attitude: state.attitude,
            rate_rad_s: Vector3::zeros(),
            source: AttitudeSource::Quaternion,
        });
        let place = self.place(state);
        let position = global_position(&GlobalPosition {
            boot: self.boot(at),
            latitude_deg: place.latitude_deg(),
            longitude_deg: place.longitude_deg(),
            altitude: place.height() - self.undulation,
            above_home_m: state.position_enu_m.z,
            velocity_ned_m_s: state.velocity_ned_m_s,
            heading_rad: None,
        });
        [self.arriving(at, &attitude), self.arriving(at, &position)]
    }

    /// Heartbeat, GNSS fixed to the centimetre, and an answer to our question for the time.
    pub fn surroundings(&mut self, at: ServiceTime, state: &State) -> [(ServiceTime, Vec<u8>); 3] {
        let place = self.place(state);
        let raw = gps_raw(&GpsRaw {
            time: VehicleTime::Boot(self.boot(at)),
            fix: GnssFix::RtkFixed,
            place: Some(GnssPlace {
                latitude_deg: place.latitude_deg(),
                longitude_deg: place.longitude_deg(),
                altitude: place.height() - self.undulation,
                height: Some(place.height()),
            }),
            horizontal_sigma_m: Some(0.02),
            vertical_sigma_m: Some(0.02),
            ground_speed_m_s: None,
            course_rad: None,
            satellites: Some(17),
        });
        // We asked one transport before the vehicle's clock was read; the answer takes as long.
        let reply = timesync(&TimeSyncMessage {
            tc1_ns: self.boot(at).ns(),
            ts1_ns: (at - TRANSPORT).unix_ns(),
            target: Address::new(1, 191),
        });
        let heartbeat = autopilot_heartbeat(true);
        [
            self.arriving(at, &heartbeat),
            self.arriving(at, &raw),
            self.arriving(at, &reply),
        ]
    }

    fn arriving(&mut self, at: ServiceTime, message: &MavMessage) -> (ServiceTime, Vec<u8>) {
        (at + TRANSPORT, self.encoder.encode(message))
    }

    fn boot(&self, at: ServiceTime) -> BootTime {
        BootTime::from_ns((at - self.booted).as_nanos() as i64)
    }
}
