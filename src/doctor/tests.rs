//! What is seen, and what the judges make of it.

use super::judge;
use super::probe::autopilot::{AutopilotSeen, SyncSeen};
use super::probe::camera::{CameraSeen, EyeSeen, PairSeen};
use super::probe::computer::{ComputerSeen, DiskSpeed};
use super::probe::ground::{GroundHealth, GroundSeen};
use super::probe::mission;
use super::{Examination, Finding, Options, Section, Verdict, examine};
use crate::deliver::http::HttpError;
use crate::ingest::{CaptureClock, EyeHealth};
use crate::mission::Mission;
use crate::testing::rig;
use emberfix_frames::{ServiceTime, SignedDuration, SyncQuality, Wgs84Parts, seconds};
use emberfix_mav::SystemId;
use emberfix_mav::telemetry::{
    EstimatorFlags, EstimatorStatus, GnssFix, GpsRaw, Heartbeat, VehicleTime,
};
use std::path::Path;
use std::time::Duration;

fn gaochun() -> Mission {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("missions/gaochun.toml");
    Mission::load(&path).unwrap()
}

fn now() -> ServiceTime {
    ServiceTime::from_unix_ns(1_772_366_400_000_000_000)
}

fn named<'a>(section: &'a Section, name: &str) -> &'a Finding {
    section
        .findings
        .iter()
        .find(|finding| finding.name == name)
        .unwrap_or_else(|| panic!("no {name} in {section:?}"))
}

fn eye(mean: f64, sharpness: f64) -> EyeSeen {
    EyeSeen {
        mean,
        burnt: 0.01,
        sharpness,
        health: EyeHealth::Good,
    }
}

/// Three pairs a second for eight seconds, 40 ms old when they come.
fn camera() -> CameraSeen {
    let pair = |n: u32| PairSeen {
        at: now() + seconds(f64::from(n) / 3.0),
        arrived: now() + seconds(f64::from(n) / 3.0 + 0.04),
        skew_s: Some(0.0002),
    };
    CameraSeen {
        pairs: (0..24).map(pair).collect(),
        left: vec![eye(120.0, 0.2); 8],
        right: vec![eye(118.0, 0.19); 8],
        rows_px: vec![0.1; 8],
        ..CameraSeen::default()
    }
}

fn judged(seen: &CameraSeen) -> Section {
    judge::camera::section(seen, &rig(30.0), "tcp-listen:127.0.0.1:14600")
}

fn autopilot() -> AutopilotSeen {
    AutopilotSeen {
        vehicle: Some(SystemId(1)),
        heartbeat: Some(Heartbeat {
            vehicle_type: Heartbeat::QUADROTOR,
            autopilot: Heartbeat::PX4,
            armed: false,
            state: 3,
        }),
        heartbeats: 8,
        agent_heard: true,
        counts: [(31, 400), (33, 400), (24, 40)].into(),
        counted_s: 8.0,
        gnss: Some(GpsRaw {
            time: VehicleTime::Utc(now()),
            fix: GnssFix::Fix3d,
            place: None,
            horizontal_sigma_m: Some(1.2),
            vertical_sigma_m: Some(2.0),
            ground_speed_m_s: None,
            course_rad: None,
            satellites: Some(14),
        }),
        estimator: Some(EstimatorStatus {
            time: VehicleTime::Utc(now()),
            horizontal_sigma_m: None,
            vertical_sigma_m: None,
            flags: EstimatorFlags::HEALTHY,
        }),
        utc_ahead_s: Some(0.01),
        sync: Some(SyncSeen {
            quality: SyncQuality::Converged,
            sigma_s: Some(0.001),
            asked: 80,
            answered: 80,
        }),
        ..AutopilotSeen::default()
    }
}

fn of_autopilot(seen: &AutopilotSeen) -> Section {
    judge::autopilot::section(seen, &gaochun())
}

fn all_pass(section: &Section) {
    for finding in &section.findings {
        assert_eq!(finding.verdict, Verdict::Pass, "{finding:?}");
        assert!(finding.remedy.is_empty(), "{finding:?}");
    }
}

#[test]
fn good_camera_and_autopilot_pass_in_everything() {
    all_pass(&judged(&camera()));
    all_pass(&of_autopilot(&autopilot()));
}

#[test]
fn every_warning_and_failure_says_what_to_do() {
    let sections = [
        judged(&CameraSeen::default()),
        judged(&CameraSeen::hanging()),
        of_autopilot(&AutopilotSeen::default()),
        of_autopilot(&AutopilotSeen::hanging()),
        judge::ground::section(&None, &AutopilotSeen::default(), &gaochun()),
        judge::computer::section(&ComputerSeen::default(), now(), &autopilot(), &None),
    ];
    for finding in sections.iter().flat_map(|section| &section.findings) {
        let told = !finding.remedy.is_empty();
        assert_eq!(told, finding.verdict != Verdict::Pass, "{finding:?}");
    }
}

#[test]
fn a_camera_out_of_step_has_no_stereo_and_a_mute_one_fails() {
    let mut alone = camera();
    alone.pairs.iter_mut().for_each(|pair| pair.skew_s = None);
    assert_eq!(named(&judged(&alone), "in step").verdict, Verdict::Fail);
    let mut sometimes = camera();
    sometimes.pairs[3].skew_s = None;
    assert_eq!(named(&judged(&sometimes), "in step").verdict, Verdict::Warn);
    let mute = judged(&CameraSeen::default());
    assert_eq!(named(&mute, "pairs").verdict, Verdict::Fail);
    assert!(named(&mute, "pairs").remedy.contains("--wait"));
}

#[test]
fn a_slow_camera_and_one_that_pauses_are_told_apart() {
    let mut slow = camera();
    slow.pairs = slow.pairs.into_iter().step_by(4).collect();
    let slow = judged(&slow);
    assert_eq!(named(&slow, "pairs").verdict, Verdict::Warn);
    assert!(named(&slow, "pairs").remedy.contains("3 pairs a second"));
    let mut pausing = camera();
    pausing.pairs.drain(8..14);
    let pausing = judged(&pausing);
    assert_eq!(named(&pausing, "pairs").verdict, Verdict::Warn);
    assert!(named(&pausing, "pairs").remedy.contains("pauses"));
}

#[test]
fn a_camera_clock_that_runs_ahead_of_ours_fails() {
    let mut ahead = camera();
    for pair in &mut ahead.pairs {
        pair.at = pair.at + SignedDuration::from_millis(300);
    }
    assert_eq!(named(&judged(&ahead), "delay").verdict, Verdict::Fail);
    let arrival = CameraSeen {
        clock: CaptureClock::Arrival,
        ..camera()
    };
    assert_eq!(named(&judged(&arrival), "delay").verdict, Verdict::Warn);
}

#[test]
fn a_black_a_dark_and_a_blurred_eye_are_named() {
    let black = EyeSeen {
        health: EyeHealth::Black {
            mean: 1.0,
            deviation: 0.5,
        },
        ..eye(1.0, 0.0)
    };
    let seen = CameraSeen {
        right: vec![black; 4],
        ..camera()
    };
    assert_eq!(named(&judged(&seen), "right eye").verdict, Verdict::Fail);
    let dark = CameraSeen {
        left: vec![eye(20.0, 0.2); 8],
        ..camera()
    };
    assert!(
        named(&judged(&dark), "left eye")
            .remedy
            .contains("too dark")
    );
    let blurred = CameraSeen {
        right: vec![eye(118.0, 0.08); 8],
        ..camera()
    };
    let alike = judged(&blurred);
    let alike = named(&alike, "eyes alike");
    assert_eq!(alike.verdict, Verdict::Warn);
    assert!(alike.remedy.contains("right eye"), "{alike:?}");
}

#[test]
fn a_bent_rig_is_seen_on_the_ground() {
    let bent = |rows: f64| {
        let seen = CameraSeen {
            rows_px: vec![rows; 8],
            ..camera()
        };
        named(&judged(&seen), "eyes level").verdict
    };
    assert_eq!(bent(-0.2), Verdict::Pass);
    assert_eq!(bent(0.9), Verdict::Warn);
    assert_eq!(bent(-3.0), Verdict::Fail);
}

#[test]
fn silence_noise_and_another_vehicle_on_the_port_have_different_remedies() {
    let mut seen = AutopilotSeen::default();
    let remedy = |seen: &AutopilotSeen| named(&of_autopilot(seen), "heartbeat").remedy.clone();
    assert!(remedy(&seen).contains("cable"));
    seen.wire.garbage_bytes = 900;
    assert!(remedy(&seen).contains("baud"));
    seen.wire.frames = 12;
    assert!(remedy(&seen).contains("router"));
    seen.others.insert(7);
    assert!(remedy(&seen).contains("system_id"));
}

#[test]
fn slow_messages_warn_missing_ones_fail() {
    let mut seen = autopilot();
    seen.counts.insert(31, 160);
    seen.counts.remove(&24);
    let section = of_autopilot(&seen);
    assert_eq!(named(&section, "attitude").verdict, Verdict::Warn);
    assert_eq!(named(&section, "GNSS messages").verdict, Verdict::Fail);
}

#[test]
fn angles_count_where_no_quaternion_comes() {
    let mut seen = autopilot();
    seen.counts.remove(&31);
    seen.counts.insert(30, 800);
    let section = of_autopilot(&seen);
    assert_eq!(named(&section, "attitude").verdict, Verdict::Pass);
    assert!(named(&section, "attitude").value.contains("ATTITUDE 100.0"));
}

#[test]
fn no_fix_fails_and_few_satellites_warn() {
    let mut seen = autopilot();
    let mut gnss = seen.gnss.unwrap();
    gnss.satellites = Some(5);
    seen.gnss = Some(gnss);
    assert_eq!(named(&of_autopilot(&seen), "GNSS").verdict, Verdict::Warn);
    gnss.fix = GnssFix::Fix2d;
    seen.gnss = Some(gnss);
    assert_eq!(named(&of_autopilot(&seen), "GNSS").verdict, Verdict::Fail);
}

#[test]
fn an_estimator_that_has_not_found_its_place_fails() {
    let mut seen = autopilot();
    let mut status = seen.estimator.unwrap();
    status.flags = EstimatorFlags(0b10_0111);
    seen.estimator = Some(status);
    let section = of_autopilot(&seen);
    assert_eq!(named(&section, "estimator").verdict, Verdict::Fail);
    assert!(
        named(&section, "estimator")
            .value
            .contains("horizontal position")
    );
}

#[test]
fn a_clock_that_rests_on_arrival_warns() {
    let mut seen = autopilot();
    seen.sync = Some(SyncSeen {
        quality: SyncQuality::ArrivalOnly,
        sigma_s: Some(0.02),
        asked: 80,
        answered: 0,
    });
    assert_eq!(named(&of_autopilot(&seen), "clock").verdict, Verdict::Warn);
}

fn ground(test: Result<Duration, HttpError>) -> Option<GroundSeen> {
    Some(GroundSeen {
        url: "http://10.0.0.2:8470".to_owned(),
        health: Ok(GroundHealth {
            version: "0.1.0".to_owned(),
            ahead: Some(SignedDuration::from_millis(20)),
        }),
        test,
        datagrams: Some(Ok(Duration::from_millis(12))),
    })
}

#[test]
fn one_way_to_the_ground_is_enough_and_none_fails() {
    let deaf = AutopilotSeen {
        agent_heard: false,
        ..autopilot()
    };
    let verdicts = |seen: &Option<GroundSeen>, autopilot: &AutopilotSeen| {
        let section = judge::ground::section(seen, autopilot, &gaochun());
        section.findings.iter().map(|f| f.verdict).max().unwrap()
    };
    let ok = ground(Ok(Duration::from_millis(30)));
    assert_eq!(verdicts(&ok, &autopilot()), Verdict::Pass);
    assert_eq!(verdicts(&ok, &deaf), Verdict::Warn);
    assert_eq!(verdicts(&None, &autopilot()), Verdict::Pass);
    assert_eq!(verdicts(&None, &deaf), Verdict::Fail);
    let old = ground(Err(HttpError::Refused {
        url: String::new(),
        status: 404,
        reason: String::new(),
    }));
    assert_eq!(verdicts(&old, &autopilot()), Verdict::Warn);
    let by_http_alone = ok.map(|seen| GroundSeen {
        datagrams: Some(Err("no answer".to_owned())),
        ..seen
    });
    assert_eq!(verdicts(&by_http_alone, &autopilot()), Verdict::Warn);
}

#[test]
fn a_full_disk_a_slow_one_and_a_wrong_clock_are_found() {
    let seen = |free: u64, sync_ms: u64| ComputerSeen {
        folder: "state".to_owned(),
        free_bytes: Some(free),
        written: Some(Ok(DiskSpeed {
            bytes_per_s: 50e6,
            sync: Duration::from_millis(sync_ms),
        })),
        waiting: Some(Ok(vec![("http", 0)])),
    };
    let judged = |seen: &ComputerSeen, now| {
        judge::computer::section(seen, now, &autopilot(), &ground(Ok(Duration::ZERO)))
    };
    all_pass(&judged(&seen(20_000_000_000, 5), now()));
    let full = judged(&seen(1_000_000, 5), now());
    assert_eq!(named(&full, "disk space").verdict, Verdict::Fail);
    let slow = judged(&seen(20_000_000_000, 400), now());
    assert_eq!(named(&slow, "disk writes").verdict, Verdict::Warn);
    let unset = judged(&seen(20_000_000_000, 5), ServiceTime::from_unix_ns(0));
    assert_eq!(named(&unset, "UTC").verdict, Verdict::Fail);
}

#[test]
fn a_vehicle_below_the_ground_or_far_away_is_told() {
    let mission = gaochun();
    let sunk = mission
        .datum
        .at_height(emberfix_frames::EllipsoidHeight::from_m(-25.0));
    let findings = judge::mission::terrain(&mission, Some(sunk));
    let verdict = |name| findings.iter().find(|f| f.name == name).unwrap().verdict;
    assert_eq!(verdict("terrain"), Verdict::Pass);
    assert_eq!(verdict("place"), Verdict::Pass);
    assert_eq!(verdict("height"), Verdict::Warn);
    let elsewhere = emberfix_frames::place_from_degrees(
        47.0,
        8.0,
        emberfix_frames::EllipsoidHeight::from_m(500.0),
    )
    .unwrap();
    let findings = judge::mission::terrain(&mission, Some(elsewhere));
    let place = findings.iter().find(|f| f.name == "place").unwrap();
    assert_eq!(place.verdict, Verdict::Fail);
}

#[test]
fn problems_of_mission_and_rig_come_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let mission_text = include_str!("../../missions/gaochun.toml")
        .replace("../calib/rigs/oakd-75mm.toml", "rig.toml")
        .replace("latitude_deg = 31.4", "latitude_deg = 331.4")
        .replace("tilt_deg", "tild_deg");
    let rig_text = include_str!("../../calib/rigs/oakd-75mm.toml")
        .replace("max_skew_s = 0.001", "max_skew_s = 1.0");
    let path = folder.path().join("mission.toml");
    std::fs::write(&path, mission_text).unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig_text).unwrap();
    let section = judge::mission::file(&path, &mission::read(&path));
    let all: Vec<&str> = section.findings.iter().map(|f| f.value.as_str()).collect();
    let all = all.join("\n");
    for key in ["latitude_deg", "tild_deg", "max_skew_s"] {
        assert!(all.contains(key), "{key}: {all}");
    }
    let options = Options::default();
    let examination = examine(&path, &options, &|_| ());
    assert!(examination.refused);
    assert_eq!(examination.verdict(), Verdict::Fail);
}

#[test]
fn figures_hold_exactly_when_nothing_fails() {
    let examination = |section| Examination {
        mission: "test".to_owned(),
        began_at: now(),
        took_s: 1.0,
        refused: false,
        sections: vec![section],
    };
    let good = examination(of_autopilot(&autopilot()));
    assert!(good.figures().iter().all(|figure| figure.holds));
    let mut seen = autopilot();
    seen.counts.remove(&33);
    let bad = examination(of_autopilot(&seen));
    assert_eq!(bad.count(Verdict::Fail), 1);
    let broken: Vec<_> = bad.figures().into_iter().filter(|f| !f.holds).collect();
    assert_eq!(broken.len(), 2, "doctor.fails and the rate: {broken:?}");
}
