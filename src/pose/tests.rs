use super::*;
use emberfix_frames::UnitQuaternion;
use emberfix_mav::telemetry::GimbalYaw;
use proptest::prelude::*;
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
    poses.heights = Heights::default();
    let pose = fresh(poses.at(service(2050), service(2110)));
    assert!(pose.degraded.contains(&Degraded::GeoidApplied));
    let egm96 = emberfix_frames::Geoid::exact(31.0, 119.0).m();
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
    let nothing = PoseEstimator::new(PoseConfig::default());
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

fn gimballed(readout_s: f64) -> PoseEstimator {
    let mut poses = PoseEstimator::new(PoseConfig {
        gimbal: Some(GimbalConfig {
            pivot_m: Vector3::new(0.5, 0.0, 0.2),
            component: None,
            device: 0,
        }),
        rolling_readout_s: readout_s,
        ..PoseConfig::default()
    });
    let other = flying();
    poses.sync = other.sync;
    poses.attitudes = other.attitudes;
    poses.positions = other.positions;
    poses.gnss = other.gnss;
    poses.heights = other.heights;
    poses
}

/// The airframe's heading is 0.1 at 2050 ms.
const HEADING: f64 = 0.1;
const GIMBAL: ComponentId = ComponentId(154);

fn gimbal_says(yaw: GimbalYaw, (roll, pitch, heading): (f64, f64, f64)) -> GimbalDeviceAttitude {
    GimbalDeviceAttitude {
        boot: BootTime::from_ms(0),
        device: 0,
        quaternion: UnitQuaternion::from_euler_angles(roll, pitch, heading),
        yaw,
        nose_rad: None,
        is_faulty: false,
        rate_rad_s: None,
    }
}

/// The same report at 2000 and at 2100 ms, from the autopilot, whose clock it shares.
fn hold(poses: &mut PoseEstimator, said: GimbalDeviceAttitude) {
    for ms in [2000_u32, 2100] {
        let said = GimbalDeviceAttitude {
            boot: BootTime::from_ms(ms),
            ..said
        };
        assert!(poses.add_gimbal(ComponentId::AUTOPILOT, service(i64::from(ms) + 3), &said));
    }
}

/// Where the platform's forward axis points: east, north, up.
fn forward(pose: &Pose) -> Vector3<f64> {
    let axis = emberfix_frames::Vector::from_metres(Vector3::x());
    pose.attitude.enu_from_body().transform(axis).metres()
}

#[test]
fn gimbal_yaw_counts_from_the_nose_or_from_north_as_its_frame_says() {
    let looks = |yaw, angles| {
        let mut poses = gimballed(0.0);
        hold(&mut poses, gimbal_says(yaw, angles));
        forward(&fresh(poses.at(service(2050), service(2110))))
    };
    let towards = |heading: f64, down: f64| {
        Vector3::new(
            heading.sin() * down.cos(),
            heading.cos() * down.cos(),
            -down.sin(),
        )
    };
    let down = 30_f64.to_radians();
    for (yaw, angles, expected) in [
        (GimbalYaw::FromNose, (0.0, 0.0, 0.0), towards(HEADING, 0.0)),
        (
            GimbalYaw::FromNose,
            (0.0, 0.0, FRAC_PI_2),
            towards(HEADING + FRAC_PI_2, 0.0),
        ),
        (
            GimbalYaw::FromNose,
            (0.0, -down, FRAC_PI_2),
            towards(HEADING + FRAC_PI_2, down),
        ),
        (GimbalYaw::FromNorth, (0.0, 0.0, FRAC_PI_2), Vector3::x()),
        (
            GimbalYaw::FromNorth,
            (0.3, -down, -FRAC_PI_2),
            towards(-FRAC_PI_2, down),
        ),
        (GimbalYaw::FromNorth, (0.0, -FRAC_PI_2, 1.0), -Vector3::z()),
    ] {
        let found = looks(yaw, angles);
        assert!(
            (found - expected).norm() < 1e-6,
            "{yaw:?} {angles:?}: {found} {expected}"
        );
    }
}

#[test]
fn a_stabilised_gimbal_stays_level_and_its_pivot_swings_with_the_airframe() {
    let mut poses = gimballed(0.0);
    // Nose to the north, right wing 90 degrees down: 0.2 m below the body is to the left, west.
    let banked = Attitude::from_angles(FRAC_PI_2, 0.0, 0.0);
    poses.attitudes.clear();
    for ms in [2000, 2100] {
        poses.add_attitude(
            BootTime::from_ms(ms),
            service(i64::from(ms) + 3),
            banked,
            Vector3::zeros(),
        );
    }
    let fixed = {
        let mut airframe = flying();
        airframe.attitudes.clear();
        for ms in [2000, 2100] {
            airframe.add_attitude(
                BootTime::from_ms(ms),
                service(i64::from(ms) + 3),
                banked,
                Vector3::zeros(),
            );
        }
        fresh(airframe.at(service(2050), service(2110))).place
    };
    hold(
        &mut poses,
        gimbal_says(GimbalYaw::FromNose, (0.0, 0.0, 0.0)),
    );
    let pose = fresh(poses.at(service(2050), service(2110)));
    assert!(
        (forward(&pose) - Vector3::y()).norm() < 1e-6,
        "{}",
        forward(&pose)
    );
    assert!(
        pose.attitude.angles().0.abs() < 1e-6,
        "the platform is level"
    );
    let moved = emberfix_frames::enu_offset(&fixed, &pose.place);
    assert!(
        (moved - Vector3::new(-0.2, 0.5, 0.0)).norm() < 1e-6,
        "{moved}"
    );
}

#[test]
fn a_gimbal_that_turns_has_its_own_rate_and_that_of_the_nose() {
    let mut poses = gimballed(0.0);
    poses.attitudes.clear();
    // The nose turns right by 1 rad/s, the gimbal follows it and tilts down by 0.5 rad/s.
    for ms in [2000_u32, 2100] {
        let turned = f64::from(ms - 2000) * 1e-3;
        let attitude = Attitude::from_angles(0.0, 0.0, turned);
        poses.add_attitude(
            BootTime::from_ms(ms),
            service(i64::from(ms) + 3),
            attitude,
            Vector3::z(),
        );
        let said = GimbalDeviceAttitude {
            boot: BootTime::from_ms(ms),
            ..gimbal_says(GimbalYaw::FromNose, (0.0, -0.5 * turned, 0.0))
        };
        assert!(poses.add_gimbal(ComponentId::AUTOPILOT, service(i64::from(ms) + 3), &said));
    }
    let pose = fresh(poses.at(service(2050), service(2110)));
    let (_, pitch, heading) = pose.attitude.angles();
    assert!((pitch + 0.025).abs() < 1e-6 && (heading - 0.05).abs() < 1e-6);
    // Half-way it looks 0.025 rad down: the turn about the vertical leaks into the roll axis.
    assert!(
        (pose.rate_rad_s - Vector3::new(0.025, -0.5, 1.0)).norm() < 1e-3,
        "{}",
        pose.rate_rad_s
    );
}

#[test]
fn a_gimbal_that_is_missing_stale_faulty_or_at_odds_gives_no_pose_by_name() {
    let ask = |poses: &PoseEstimator| poses.at(service(2050), service(2400));
    let says = gimbal_says(GimbalYaw::FromNose, (0.0, 0.0, 0.0));
    assert_eq!(
        ask(&gimballed(0.0)),
        PoseAnswer::NeverSeen {
            what: "gimbal attitude"
        }
    );

    let mut stale = gimballed(0.0);
    let early = GimbalDeviceAttitude {
        boot: BootTime::from_ms(1000),
        ..says
    };
    assert!(stale.add_gimbal(ComponentId::AUTOPILOT, service(1003), &early));
    assert!(matches!(
        ask(&stale),
        PoseAnswer::Stale {
            what: "gimbal attitude",
            ..
        }
    ));

    let mut faulty = gimballed(0.0);
    let broken = GimbalDeviceAttitude {
        is_faulty: true,
        ..says
    };
    assert!(!faulty.add_gimbal(ComponentId::AUTOPILOT, service(2003), &broken));

    // Yaw said to count from the nose, though it counts from north: the gimbal's own word on the
    // nose gives it away.
    let mut odd = gimballed(0.0);
    hold(
        &mut odd,
        GimbalDeviceAttitude {
            nose_rad: Some(HEADING + 1.0),
            ..says
        },
    );
    assert!(
        matches!(ask(&odd), PoseAnswer::Conflict { apart_deg, .. } if (apart_deg - 57.3).abs() < 0.1)
    );
    let mut agreed = gimballed(0.0);
    hold(
        &mut agreed,
        GimbalDeviceAttitude {
            nose_rad: Some(HEADING - 0.2),
            ..says
        },
    );
    assert!(matches!(ask(&agreed), PoseAnswer::Fresh(_)));
}

#[test]
fn another_gimbal_is_not_ours_and_a_gimbal_has_a_clock_of_its_own() {
    let mut poses = gimballed(0.0);
    // Booted 7 s after the autopilot; reports take 3 ms.
    for ms in [1900_u32, 2000, 2100] {
        let tilt = f64::from(ms - 2000_u32.min(ms)) * 1e-3;
        let said = GimbalDeviceAttitude {
            boot: BootTime::from_ms(ms + 60_000),
            ..gimbal_says(GimbalYaw::FromNorth, (0.0, -tilt, 0.0))
        };
        assert!(poses.add_gimbal(GIMBAL, service(i64::from(ms) + 3), &said));
        assert!(!poses.add_gimbal(ComponentId(171), service(i64::from(ms) + 3), &said));
        let second = GimbalDeviceAttitude { device: 2, ..said };
        assert!(!poses.add_gimbal(GIMBAL, service(i64::from(ms) + 3), &second));
    }
    let pose = fresh(poses.at(service(2053), service(2110)));
    assert!(
        (pose.attitude.angles().1 + 0.05).abs() < 1e-6,
        "{}",
        pose.attitude.angles().1
    );
    assert!(
        pose.time_sigma_s >= 0.02,
        "arrivals alone: {}",
        pose.time_sigma_s
    );
}

#[test]
fn a_slow_gimbal_is_named_and_unsure() {
    let mut poses = gimballed(0.0);
    for ms in [1950_u32, 2150] {
        let said = GimbalDeviceAttitude {
            boot: BootTime::from_ms(ms),
            ..gimbal_says(GimbalYaw::FromNose, (0.0, 0.0, 0.0))
        };
        assert!(poses.add_gimbal(ComponentId::AUTOPILOT, service(i64::from(ms) + 3), &said));
    }
    let pose = fresh(poses.at(service(2050), service(2160)));
    assert!(pose.degraded.contains(&Degraded::GimbalSlow));
    assert!(
        pose.attitude_noise_rad > 0.014,
        "{}",
        pose.attitude_noise_rad
    );
}

#[test]
fn a_rolling_shutter_widens_each_bearing_then_is_named_then_gives_no_pose() {
    let turning = |rate: f64, readout_s: f64| {
        let mut poses = PoseEstimator::new(PoseConfig {
            rolling_readout_s: readout_s,
            ..PoseConfig::default()
        });
        let other = flying();
        (poses.sync, poses.positions, poses.gnss) = (other.sync, other.positions, other.gnss);
        poses.heights = other.heights;
        for ms in [2000_u32, 2100] {
            let at = BootTime::from_ms(ms);
            let attitude = Attitude::from_angles(0.0, 0.0, 0.0);
            poses.add_attitude(
                at,
                service(i64::from(ms) + 3),
                attitude,
                Vector3::z() * rate,
            );
        }
        poses.at(service(2050), service(2110))
    };
    let still = fresh(turning(0.0, 0.02));
    let global = fresh(turning(0.5, 0.0));
    assert!(!global.degraded.contains(&Degraded::RollingShutter));
    let turned = fresh(turning(0.5, 0.02));
    // 0.5 rad/s over 20 ms: 10 mrad from first row to last, 2.9 mrad one sigma.
    let added = (turned.attitude_noise_rad.powi(2) - still.attitude_noise_rad.powi(2)).sqrt();
    assert!((added - 0.010 / 12_f64.sqrt()).abs() < 1e-9, "{added}");
    assert!(turned.degraded.contains(&Degraded::RollingShutter));
    // At 10 m/s the camera moves by 0.2 m meanwhile.
    assert!((still.position_noise_m.powi(2) - global.position_noise_m.powi(2)).sqrt() > 0.05);
    assert!(
        matches!(turning(3.0, 0.02), PoseAnswer::TooFast { turned_deg, .. } if turned_deg > 3.4)
    );
}

/// PX4 falls back to barometric altitude, or to 0, without a flag.
#[test]
fn an_altitude_that_leaves_the_receivers_is_named_and_the_ellipse_is_as_tall_as_the_gap() {
    let flown = |altitudes: &[f64]| {
        let mut poses = flying();
        for altitude in altitudes {
            poses.latest_altitude = Some((service(2000), MslAltitude::from_m(*altitude)));
            poses.add_gnss_altitude(service(2001), MslAltitude::from_m(20.0));
        }
        fresh(poses.at(service(2050), service(2110)))
    };
    let usual = flown(&[20.5; 50]);
    assert!(!usual.degraded.contains(&Degraded::AltitudeDisagrees));
    assert!(
        (usual.gnss_vertical_m - 2.0).abs() < 1e-9,
        "what the receiver says"
    );
    // A filter that is 3 m off for long is no fallback, but no 2 m altitude either.
    let off = flown(&[23.0; 50]);
    assert!(!off.degraded.contains(&Degraded::AltitudeDisagrees));
    assert!((off.gnss_vertical_m - 3.0).abs() < 1e-6);
    let jumped = flown(&[[20.5; 50].as_slice(), &[29.0; 3]].concat());
    assert!(jumped.degraded.contains(&Degraded::AltitudeDisagrees));
    assert!(
        (jumped.gnss_vertical_m - 9.0).abs() < 1e-6,
        "{}",
        jumped.gnss_vertical_m
    );
    let zero = flown(&[[540.0; 0].as_slice(), &[0.0; 3]].concat());
    assert!(zero.degraded.contains(&Degraded::AltitudeDisagrees));
    let drifted: Vec<f64> = (0..3000).map(|i| 20.0 + 0.005 * f64::from(i)).collect();
    let drifted = flown(&drifted);
    assert!(drifted.degraded.contains(&Degraded::AltitudeDisagrees));
    assert!(drifted.gnss_vertical_m > 10.0);
    let back = flown(&[[20.5; 50].as_slice(), &[29.0; 3], &[20.5; 3]].concat());
    assert!(!back.degraded.contains(&Degraded::AltitudeDisagrees));
}

#[test]
fn a_vertical_position_that_the_autopilot_calls_invalid_is_named() {
    let mut poses = flying();
    poses.add_vertical_validity(false);
    let pose = fresh(poses.at(service(2050), service(2110)));
    assert!(pose.degraded.contains(&Degraded::AltitudeNotEstimated));
    assert!(pose.gnss_vertical_m >= 10.0);
    poses.add_vertical_validity(true);
    let pose = fresh(poses.at(service(2050), service(2110)));
    assert!(pose.degraded.is_empty());
}

#[test]
fn a_separation_that_no_geoid_has_is_not_used_and_a_second_receiver_stands_in() {
    let height = |poses: &PoseEstimator| fresh(poses.at(service(2050), service(2110)));
    let model = emberfix_frames::Geoid::exact(31.0, 119.0).m();

    let mut absurd = flying();
    absurd.heights = Heights::default();
    absurd.add_gnss(
        service(2000),
        true,
        (Some(1.2), Some(2.0)),
        Some(GeoidUndulation::from_m(model + 40.0)),
    );
    let pose = height(&absurd);
    assert!(pose.degraded.contains(&Degraded::GeoidDisagrees));
    assert!((pose.place.height().m() - 20.0 - model).abs() < 0.01);
    assert!((pose.gnss_vertical_m - 40.0).abs() < 0.01);

    let mut second = flying();
    second.heights = Heights::default();
    second.add_second_separation(GeoidUndulation::from_m(model + 1.0));
    let pose = height(&second);
    assert!(pose.degraded.is_empty(), "{:?}", pose.degraded);
    assert!((pose.place.height().m() - 21.0 - model).abs() < 0.01);
}

/// What may go wrong with what is told.
#[derive(Debug, Clone, Copy, Default)]
struct Faults {
    no_accuracy: bool,
    no_separation: bool,
    absurd_separation: bool,
    altitude_jumps: bool,
    altitude_invalid: bool,
    no_timesync: bool,
    attitude_slow: bool,
    position_slow: bool,
}

impl Faults {
    fn reasons(self) -> BTreeSet<Degraded> {
        let named = [
            (self.no_accuracy, Degraded::GnssAccuracyUnknown),
            (
                self.no_separation && !self.absurd_separation,
                Degraded::GeoidApplied,
            ),
            (self.absurd_separation, Degraded::GeoidDisagrees),
            (self.altitude_jumps, Degraded::AltitudeDisagrees),
            (self.altitude_invalid, Degraded::AltitudeNotEstimated),
            (self.no_timesync, Degraded::ClockNotSynced),
            (self.attitude_slow, Degraded::AttitudeSlow),
            (self.position_slow, Degraded::PositionSlow),
        ];
        let happened = named.into_iter().filter(|(happens, _)| *happens);
        happened.map(|(_, reason)| reason).collect()
    }

    /// A pose at 2.05 s, of a receiver that says these sigmas until the faults begin.
    fn pose(self, (horizontal_m, vertical_m): (f64, f64)) -> Pose {
        let mut poses = if self.no_timesync {
            PoseEstimator::new(PoseConfig::default())
        } else {
            synced()
        };
        let separation = match (self.absurd_separation, self.no_separation) {
            (true, _) => Some(GeoidUndulation::from_m(-60.0)),
            (false, true) => None,
            (false, false) => Some(GeoidUndulation::from_m(10.0)),
        };
        let stated = (Some(horizontal_m), Some(vertical_m));
        poses.add_gnss(service(1790), true, stated, separation);
        let latest = if self.no_accuracy {
            (None, None)
        } else {
            stated
        };
        poses.add_gnss(service(1990), true, latest, separation);
        let later = |slow: bool| if slow { 2300 } else { 2100 };
        position(&mut poses, 2000, 0.0, 10.0);
        for receiver_m in [20.0, if self.altitude_jumps { 60.0 } else { 20.0 }] {
            poses.add_gnss_altitude(service(2010), MslAltitude::from_m(receiver_m));
        }
        let position_ms = later(self.position_slow);
        position(
            &mut poses,
            position_ms,
            1e-2 * f64::from(position_ms - 2000),
            10.0,
        );
        attitude(&mut poses, 2000, 0.0);
        attitude(&mut poses, later(self.attitude_slow), 0.2);
        poses.add_vertical_validity(!self.altitude_invalid);
        fresh(poses.at(service(2050), service(2310)))
    }
}

fn sigmas(pose: &Pose) -> [f64; 5] {
    [
        pose.gnss_horizontal_m,
        pose.gnss_vertical_m,
        pose.attitude_noise_rad,
        pose.position_noise_m,
        pose.time_sigma_s,
    ]
}

proptest! {
    /// Bad or missing input widens and is named; nothing that goes wrong makes anything surer.
    #[test]
    fn whatever_goes_wrong_is_named_and_never_narrows(
        happens in prop::array::uniform8(any::<bool>()),
        horizontal_m in 0.02..20.0_f64,
        vertical_m in 0.02..30.0_f64,
    ) {
        let [no_accuracy, no_separation, absurd_separation, altitude_jumps, ..] = happens;
        let [.., altitude_invalid, no_timesync, attitude_slow, position_slow] = happens;
        let faults = Faults {
            no_accuracy,
            no_separation,
            absurd_separation,
            altitude_jumps,
            altitude_invalid,
            no_timesync,
            attitude_slow,
            position_slow,
        };
        let stated = (horizontal_m, vertical_m);
        let (healthy, faulty) = (Faults::default().pose(stated), faults.pose(stated));
        prop_assert_eq!(&healthy.degraded, &BTreeSet::new());
        prop_assert_eq!(&faulty.degraded, &faults.reasons());
        for (well, ill) in sigmas(&healthy).into_iter().zip(sigmas(&faulty)) {
            prop_assert!(ill >= well, "{} of {}: {:?}", ill, well, faults);
        }
    }
}
