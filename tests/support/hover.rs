//! A recording of a vehicle that hovers before the pictures' surface.

use crate::flight::{State, Vehicle};
use crate::pictures;
use crate::support::Scratch;
use emberfix::ingest::StereoPair;
use emberfix::record::{RecordOptions, Tape};
use emberfix_calib::Rig;
use emberfix_frames::{
    Attitude, EllipsoidHeight, GeoidUndulation, ServiceTime, SignedDuration, Vector3,
};
use std::path::PathBuf;

/// 2026-03-01T12:00:00Z.
const START: ServiceTime = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);
/// Telemetry and pictures, 10 Hz.
const STEP: SignedDuration = SignedDuration::from_millis(100);
/// Telemetry before the first picture: clocks and receiver need a while.
const LEAD: i32 = 20;

/// Writes `rec.mcap` with `pairs` pairs, each as `change` leaves it.
pub fn record(scratch: &Scratch, pairs: u64, change: impl Fn(&mut StereoPair)) -> PathBuf {
    let rig = Rig::load(&scratch.path("rig.toml")).unwrap();
    let path = scratch.path("rec.mcap");
    let mut tape = Tape::create(&path, &rig, &RecordOptions::default()).unwrap();
    let (height, undulation) = (EllipsoidHeight::from_m(23.0), GeoidUndulation::from_m(3.0));
    let booted = START - SignedDuration::from_secs(60);
    let mut vehicle = Vehicle::new((31.409422, 119.112017), height, undulation, booted);
    let hover = State {
        position_enu_m: Vector3::zeros(),
        velocity_ned_m_s: Vector3::zeros(),
        attitude: Attitude::from_angles(0.0, 0.0, 0.0),
    };
    let steps = i32::try_from(pairs).unwrap();
    for step in -LEAD..steps + 10 {
        let at = START + STEP * step;
        let frames = vehicle
            .surroundings(at, &hover)
            .into_iter()
            .chain(vehicle.pose(at, &hover));
        for (arrived, frame) in frames {
            tape.write_mavlink(arrived, &frame).unwrap();
        }
        if (0..steps).contains(&step) {
            let mut pair = pictures::pair(step as u64, at + STEP / 2);
            change(&mut pair.value);
            tape.write_pair(&pair).unwrap();
        }
    }
    tape.finish().unwrap();
    path
}
