//! Real telemetry logs through the real reader, against figures that pymavlink gave for the same
//! files. The logs are for tests only and not part of the project.

use emberfix_mav::tlog::TlogSummary;
use std::path::PathBuf;

fn summary(name: &str) -> Option<TlogSummary> {
    let beside = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared");
    let shared = std::env::var_os("EMBERFIX_SHARED").map_or(beside, PathBuf::from);
    match std::fs::read(shared.join("data/mavlink").join(name)) {
        Ok(log) => Some(TlogSummary::of(&log)),
        Err(_) => {
            println!("skipped: no shared data");
            None
        }
    }
}

/// Figures are printed to two decimals.
fn assert_rates(summary: &TlogSummary, expected: &[(&str, f64)]) {
    for (name, rate_hz) in expected {
        let found = summary.messages[*name].rate_hz;
        assert!(
            (found - rate_hz).abs() < 0.006,
            "{name}: {found} Hz, expected {rate_hz}"
        );
    }
}

#[test]
fn a_real_flight_over_mavlink_2() {
    let Some(flight) = summary("cuav_2018_flight_v2.tlog") else {
        return;
    };
    assert_eq!((flight.frames, flight.skipped_bytes), (19_205, 0));
    assert!((flight.duration_s - 185.0).abs() < 0.06);
    assert_rates(
        &flight,
        &[
            ("GPS_RAW_INT", 3.96),
            ("GLOBAL_POSITION_INT", 3.65),
            ("ATTITUDE", 3.26),
            ("SYSTEM_TIME", 2.95),
            ("HEARTBEAT", 1.95),
            ("TIMESYNC", 0.10),
        ],
    );
    assert_eq!(flight.messages["MISSION_ITEM"].count, 262);
    let track = flight.track.unwrap();
    assert_eq!(
        track.positions,
        flight.messages["GLOBAL_POSITION_INT"].count
    );
    println!("{}", format_args!("{track:?} refused {:?}", flight.refused));
}

#[test]
fn a_utc_of_the_year_2908_is_refused_every_time() {
    let Some(flight) = summary("cuav_2018_flight_v2.tlog") else {
        return;
    };
    assert_eq!(flight.absurd_utc, flight.messages["SYSTEM_TIME"].count);
}

#[test]
fn a_simulated_flight_over_mavlink_1() {
    let Some(flight) = summary("sitl_vtol_v1.tlog") else {
        return;
    };
    assert_eq!(
        (flight.frames, flight.skipped_bytes, flight.absurd_utc),
        (23_894, 0, 0)
    );
    assert!((flight.duration_s - 207.6).abs() < 0.06);
    assert_rates(
        &flight,
        &[
            ("GPS_RAW_INT", 3.85),
            ("GLOBAL_POSITION_INT", 3.89),
            ("ATTITUDE", 4.28),
            ("SYSTEM_TIME", 3.91),
            ("HEARTBEAT", 0.96),
        ],
    );
    assert_eq!(flight.messages["HOME_POSITION"].count, 6);
}

#[test]
fn a_bench_without_a_fix_never_gives_a_position() {
    let Some(bench) = summary("bench_nofix_v1.tlog") else {
        return;
    };
    assert_eq!((bench.frames, bench.track), (2_632, None));
    assert!((bench.duration_s - 52.5).abs() < 0.06);
    assert_rates(
        &bench,
        &[
            ("GPS_RAW_INT", 2.67),
            ("ATTITUDE", 2.67),
            ("HEARTBEAT", 1.85),
        ],
    );
    let positions = bench.messages["GLOBAL_POSITION_INT"].count;
    assert_eq!(bench.refused.get("null_position"), Some(&positions));
}
