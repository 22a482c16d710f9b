use super::*;
use std::f64::consts::FRAC_PI_2;

const START_NS: i64 = 1_772_366_400_000_000_000;

fn service(ms: i64) -> ServiceTime {
    ServiceTime::from_unix_ns(START_NS + ms * 1_000_000)
}

/// Boot clock reads `ms` when the service clock reads `service(ms)`; exchanges take 2 ms.
fn synced() -> PoseEstimator {
    let mut poses = PoseEstimator::new(PoseConfig::default());
    for i in 0..20 {
        let asked = service(100 * i);
        let answered = service(100 * i + 2);
        let remote = BootTime::from_ms(u32::try_from(100 * i + 1).unwrap());
        assert!(poses.add_timesync(TimeSyncSample {
            asked,
            remote,
            answered
        }));
    }
    poses
}

fn position(poses: &mut PoseEstimator, ms: u32, north_m: f64, north_m_s: f64) {
    let latitude = 31.0 + north_m / 110_863.0;
    let velocity_ned = Vector3::new(north_m_s, 0.0, 0.0);
    poses.add_position(
        BootTime::from_ms(ms),
        service(i64::from(ms) + 3),
        (latitude, 119.0),
        MslAltitude::from_m(20.0),
        velocity_ned,
    );
}

fn attitude(poses: &mut PoseEstimator, ms: u32, heading_rad: f64) {
    let attitude = Attitude::from_angles(0.0, 0.0, heading_rad);
    let rate = Vector3::zeros();
    poses.add_attitude(
        BootTime::from_ms(ms),
        service(i64::from(ms) + 3),
        attitude,
        rate,
    );
}

fn gnss(poses: &mut PoseEstimator, ms: i64, fix: bool) {
    let sigmas = (Some(1.2), Some(2.0));
    poses.add_gnss(
        service(ms),
        fix,
        sigmas,
        Some(GeoidUndulation::from_m(10.0)),
    );
}

fn flying() -> PoseEstimator {
    let mut poses = synced();
    gnss(&mut poses, 1990, true);
    for (ms, north) in [(2000, 0.0), (2100, 1.0)] {
        position(&mut poses, ms, north, 10.0);
        attitude(&mut poses, ms, if ms == 2000 { 0.0 } else { 0.2 });
    }
    poses
}

fn fresh(answer: PoseAnswer) -> Pose {
    match answer {
        PoseAnswer::Fresh(pose) => *pose,
        other => panic!("{other:?}"),
    }
}

#[test]
fn position_and_attitude_are_those_of_mid_exposure() {
    let pose = fresh(flying().at(service(2050), service(2110)));
    assert!((pose.attitude.angles().2 - 0.1).abs() < 1e-9);
    let start = place_from_degrees(31.0, 119.0, EllipsoidHeight::from_m(30.0)).unwrap();
    let moved = emberfix_frames::enu_offset(&start, &pose.place);
    // 110863 m per degree is good to 1e-5 of the 0.5 m moved.
    assert!(
        (moved - Vector3::new(0.0, 0.5, 0.0)).norm() < 1e-3,
        "{moved}"
    );
    assert!(pose.degraded.is_empty(), "{:?}", pose.degraded);
}

#[test]
fn ellipsoid_height_is_msl_plus_the_receivers_own_separation() {
    let pose = fresh(flying().at(service(2050), service(2110)));
    assert!((pose.place.height().m() - 30.0).abs() < 1e-3);
}

#[test]
fn without_a_separation_egm96_is_used_and_said() {
    let mut poses = flying();
    poses.separation = None;
    let pose = fresh(poses.at(service(2050), service(2110)));
    assert!(pose.degraded.contains(&Degraded::GeoidApplied));
    let egm96 = Geoid::new().undulation(31.0, 119.0).m();
    assert!(egm96.abs() > 1.0, "a place where the mix-up shows: {egm96}");
    assert!((pose.place.height().m() - 20.0 - egm96).abs() < 0.01);
}

#[test]
fn heading_turns_the_short_way_over_north() {
    let mut poses = synced();
    gnss(&mut poses, 1990, true);
    for (ms, heading) in [(2000, -0.1), (2100, 0.1)] {
        position(&mut poses, ms, 0.0, 0.0);
        attitude(&mut poses, ms, heading + 2.0 * std::f64::consts::PI);
    }
    let pose = fresh(poses.at(service(2050), service(2110)));
    assert!(pose.attitude.angles().2.abs() < 1e-9);
    assert!(pose.attitude.angles().2.abs() < FRAC_PI_2);
}

#[test]
fn an_image_waits_for_the_telemetry_that_follows_it() {
    assert_eq!(
        flying().at(service(2105), service(2120)),
        PoseAnswer::NotYet
    );
    // After the wait it is extrapolated: 5 ms at 10 m/s.
    let pose = fresh(flying().at(service(2105), service(2400)));
    let start = place_from_degrees(31.0, 119.0, EllipsoidHeight::from_m(30.0)).unwrap();
    let moved = emberfix_frames::enu_offset(&start, &pose.place).y;
    assert!((moved - 1.05).abs() < 1e-3, "{moved}");
}

#[test]
fn stale_missing_and_fixless_telemetry_give_no_pose() {
    let old = flying().at(service(2700), service(3000));
    assert!(
        matches!(
            old,
            PoseAnswer::Stale {
                what: "attitude",
                ..
            }
        ),
        "{old:?}"
    );
    let mut poses = flying();
    gnss(&mut poses, 2105, false);
    assert_eq!(
        poses.at(service(2050), service(2110)),
        PoseAnswer::NoGnssFix
    );
    let mut nothing = PoseEstimator::new(PoseConfig::default());
    assert!(matches!(
        nothing.at(service(0), service(0)),
        PoseAnswer::NeverSeen { .. }
    ));
}

#[test]
fn nothing_is_interpolated_across_a_reboot() {
    let mut poses = flying();
    poses.add_attitude(
        BootTime::from_ms(10),
        service(60_000),
        Attitude::from_angles(0.0, 0.0, 1.0),
        Vector3::zeros(),
    );
    assert_eq!(poses.attitudes.latest(), Some(BootTime::from_ms(10)));
    assert_eq!(poses.positions.latest(), None);
}
