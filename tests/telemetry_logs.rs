//! Real telemetry logs through `emberfix replay`, held against what pymavlink reads from the same files.
//!
//! Counts and gaps are facts and have to be equal. Tolerances: both sides take times from the same
//! 8-byte headers; pymavlink keeps them as double-precision seconds (0.2 us in 2026) and prints to the
//! microsecond, rates to four decimals. Positions are integers of 1e-7 degrees and millimetres in both.

#![expect(clippy::unwrap_used, reason = "a test may stop at its first surprise")]

#[path = "support/clients.rs"]
#[expect(dead_code, reason = "nothing runs beside these tests")]
mod clients;
#[path = "support/replays.rs"]
mod replays;
#[path = "support/shared.rs"]
mod shared;
mod support;

use clients::Clients;
use emberfix::locate::SharedPriors;
use emberfix_mav::tlog::TlogReader;
use emberfix_mav::{Telemetry, decode};
use serde_json::Value;
use support::{Said, Scratch};

/// Pymavlink prints rates to four decimals.
const RATE_TOLERANCE_HZ: f64 = 0.000_06;
/// Microseconds, and the rounding of seconds since 1970 in a double.
const TIME_TOLERANCE_S: f64 = 2e-6;
/// A hundredth of the message's own step of 1e-7 degrees.
const DEGREE_TOLERANCE: f64 = 1e-9;
/// A hundredth of the message's own millimetre.
const METRE_TOLERANCE: f64 = 1e-5;

/// Our figures and pymavlink's of one log.
fn read_twice(name: &str) -> Option<(Value, Value)> {
    let log = shared::shared_data(&format!("mavlink/{name}"))?;
    let clients = Clients::find()?;
    let scratch = Scratch::new();
    let ours = replays::replay(&scratch, &log, "out", &[]).json();
    let theirs = clients
        .client("tlog_summary.py")
        .arg(&log)
        .args(["--dialect", "development"])
        .output();
    let theirs = Said::of(&theirs.unwrap()).json();
    Some((ours["telemetry"].clone(), theirs))
}

fn close(ours: &Value, theirs: &Value, tolerance: f64, what: &str) {
    let (ours, theirs) = (ours.as_f64().unwrap(), theirs.as_f64().unwrap());
    assert!(
        (ours - theirs).abs() <= tolerance,
        "{what}: {ours}, pymavlink {theirs}"
    );
}

fn same_messages(ours: &Value, theirs: &Value) {
    close(
        &ours["duration_s"],
        &theirs["length_s"],
        TIME_TOLERANCE_S,
        "duration",
    );
    assert_eq!(ours["frames"], theirs["frames"]);
    assert_eq!(theirs["bad_bytes"], 0);
    assert_eq!(ours["skipped_bytes"], 0);
    // ArduPilot's own messages stand in neither dialect; nobody can test their checksums.
    assert_eq!(ours["unchecked"], theirs["unknown_frames"]);
    let (ours, theirs) = (&ours["messages"], theirs["messages"].as_object().unwrap());
    assert!(theirs.len() > 10);
    for (name, theirs) in theirs {
        let ours = &ours[name];
        assert_eq!(ours["count"], theirs["count"], "{name}");
        assert_eq!(ours["gaps_over_1_s"], theirs["gaps"], "{name}");
        close(
            &ours["rate_hz"],
            &theirs["rate_hz"],
            RATE_TOLERANCE_HZ,
            name,
        );
        close(
            &ours["longest_gap_s"],
            &theirs["longest_gap_s"],
            TIME_TOLERANCE_S,
            name,
        );
    }
}

fn same_track(ours: &Value, theirs: &Value) {
    let (ours, theirs) = (&ours["track"], &theirs["track"]["GLOBAL_POSITION_INT"]);
    assert_eq!(ours["positions"], theirs["points"]);
    for (our_key, their_key, tolerance) in [
        ("latitude_deg", "lat_deg", DEGREE_TOLERANCE),
        ("longitude_deg", "lon_deg", DEGREE_TOLERANCE),
        ("altitude_msl_m", "alt_msl_m", METRE_TOLERANCE),
    ] {
        for (index, end) in ["min", "max"].into_iter().enumerate() {
            close(
                &ours[our_key][index],
                &theirs[end][their_key],
                tolerance,
                our_key,
            );
        }
    }
}

#[test]
fn a_real_flight_reads_as_pymavlink_reads_it() {
    let Some((ours, theirs)) = read_twice("cuav_2018_flight_v2.tlog") else {
        return;
    };
    same_messages(&ours, &theirs);
    same_track(&ours, &theirs);
    // Its clock stands in the year 2908: each time it says so, it is not believed.
    let times = &ours["messages"]["SYSTEM_TIME"]["count"];
    assert!(times.as_u64().unwrap() > 500);
    assert_eq!(&ours["absurd_utc"], times);
}

#[test]
fn a_simulated_flight_over_mavlink_1_reads_as_pymavlink_reads_it() {
    let Some((ours, theirs)) = read_twice("sitl_vtol_v1.tlog") else {
        return;
    };
    same_messages(&ours, &theirs);
    same_track(&ours, &theirs);
    assert_eq!(ours["absurd_utc"], 0, "this vehicle's clock is sane");
}

#[test]
fn a_bench_without_a_fix_has_no_track() {
    let Some((ours, theirs)) = read_twice("bench_nofix_v1.tlog") else {
        return;
    };
    same_messages(&ours, &theirs);
    assert_eq!(ours["track"], Value::Null);
    let zeros = &theirs["track"]["GLOBAL_POSITION_INT"]["zero_positions"];
    assert!(zeros.as_u64().unwrap() > 100);
    assert_eq!(
        &ours["refused"]["null_position"], zeros,
        "each is counted by its name"
    );
}

/// Seconds since start, east and north of there (metres), velocity east and north (m/s), in flight.
fn positions(log: &[u8]) -> Vec<(f64, [f64; 2], [f64; 2])> {
    let decoded = TlogReader::new(log).filter_map(|record| decode(&record.frame).ok());
    let mut first = None;
    let mut track: Vec<(f64, [f64; 2], [f64; 2])> = Vec::new();
    for telemetry in decoded {
        let Telemetry::GlobalPosition(position) = telemetry else {
            continue;
        };
        let start = *first.get_or_insert(position);
        let metres_per_deg = 6_378_137.0_f64.to_radians();
        let t_s = (position.boot.ns() - start.boot.ns()) as f64 * 1e-9;
        let east = (position.longitude_deg - start.longitude_deg)
            * metres_per_deg
            * start.latitude_deg.to_radians().cos();
        let north = (position.latitude_deg - start.latitude_deg) * metres_per_deg;
        let [v_north, v_east, _] = position.velocity_ned_m_s.into();
        let is_new = track.last().is_none_or(|last| t_s > last.0);
        if is_new && v_east.hypot(v_north) > 4.0 {
            track.push((t_s, [east, north], [v_east, v_north]));
        }
    }
    track
}

/// Mean square of how far a reported way and its velocities part in so many seconds, per axis, m².
fn parting_m2(track: &[(f64, [f64; 2], [f64; 2])], lag_s: f64) -> f64 {
    let mut strayed = vec![(track[0].0, [0.0; 2], false)];
    for pair in track.windows(2) {
        let ((from_s, from, v_from), (to_s, to, v_to)) = (pair[0], pair[1]);
        let (dt_s, last) = (to_s - from_s, strayed.last().unwrap().1);
        let by = |axis: usize| to[axis] - from[axis] - 0.5 * dt_s * (v_from[axis] + v_to[axis]);
        strayed.push((to_s, [last[0] + by(0), last[1] + by(1)], dt_s > 1.5));
    }
    let mut squares = Vec::new();
    for (index, (at_s, from, _)) in strayed.iter().enumerate() {
        let mut later = strayed[index + 1..].iter();
        let unbroken = later.by_ref().take_while(|(.., broken)| !broken);
        if let Some((_, to, _)) = unbroken.into_iter().find(|(t_s, ..)| t_s - at_s >= lag_s) {
            squares.extend([0, 1].map(|axis| (to[axis] - from[axis]).powi(2)));
        }
    }
    assert!(
        squares.len() > 500,
        "{} pairs over {lag_s} s",
        squares.len()
    );
    squares.iter().sum::<f64>() / squares.len() as f64
}

#[test]
fn velocity_and_position_of_a_real_flight_part_no_faster_than_assumed() {
    let Some(log) = shared::shared_data("mavlink/cuav_2018_flight_v2.tlog") else {
        return;
    };
    let track = positions(&std::fs::read(log).unwrap());
    let priors = SharedPriors::default();
    // A consumer receiver's share that wanders, and what its velocity strays.
    let wanders_m2 = 1.5_f64.powi(2) * (1.0 - priors.gnss_constant_share);
    for lag_s in [1.0, 10.0, 60.0] {
        let kept = (-lag_s / priors.gnss_correlation_s).exp();
        let assumed_m2 = priors.way_variance_m2_per_s() * lag_s + 2.0 * wanders_m2 * (1.0 - kept);
        let parted_m2 = parting_m2(&track, lag_s);
        println!("in {lag_s} s: {parted_m2:.3} m2, assumed {assumed_m2:.3}");
        // Eleven minutes hold ten or so of the longest spans, and two axes: a variance to a third.
        assert!(parted_m2 < 1.35 * assumed_m2, "{lag_s} s: {parted_m2} m2");
        assert!(parted_m2 > 0.1 * assumed_m2, "{lag_s} s: {parted_m2} m2");
    }
}
