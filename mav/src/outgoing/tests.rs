use super::*;
use crate::telemetry::{
    AttitudeSample, AttitudeSource, CameraTrackingGeoStatus, CommandAck, CommandInt, CommandResult,
    DecodeError, EstimatorFlags, EstimatorStatus, GlobalPosition, GnssFix, GnssPlace, GpsRaw,
    HomePosition, Severity, StatusText, SystemTime, Telemetry, TimeSyncMessage, VehicleTime,
    decode,
};
use crate::wire::RawFrame;
use emberfix_frames::{
    Attitude, BootTime, EllipsoidHeight, MslAltitude, ServiceTime, UnitQuaternion, Vector3,
};

fn through_the_wire(message: &MavMessage) -> Result<Telemetry, DecodeError> {
    let bytes = Encoder::new(Address::new(1, 1)).encode(message);
    let (frame, _) = RawFrame::at_start(&bytes).unwrap();
    assert_eq!(frame.bytes, bytes);
    decode(&frame)
}

fn position() -> GlobalPosition {
    GlobalPosition {
        boot: BootTime::from_ms(12_345),
        latitude_deg: 31.409_422_2,
        longitude_deg: 119.112_016_7,
        altitude: MslAltitude::from_m(22.25),
        above_home_m: 12.0,
        velocity_ned_m_s: Vector3::new(5.25, -1.5, 0.25),
        heading_rad: Some(std::f64::consts::FRAC_PI_2),
    }
}

fn fix() -> GpsRaw {
    GpsRaw {
        time: VehicleTime::Boot(BootTime::from_ms(12_300)),
        fix: GnssFix::Fix3d,
        place: Some(GnssPlace {
            latitude_deg: -35.5,
            longitude_deg: 149.25,
            altitude: MslAltitude::from_m(584.5),
            height: Some(EllipsoidHeight::from_m(603.75)),
        }),
        horizontal_sigma_m: Some(1.5),
        vertical_sigma_m: Some(2.5),
        ground_speed_m_s: Some(5.5),
        course_rad: Some(0.0),
        satellites: Some(17),
    }
}

#[test]
fn a_position_comes_back_in_si() {
    let Telemetry::GlobalPosition(back) = through_the_wire(&global_position(&position())).unwrap()
    else {
        panic!("not a position");
    };
    // Wire resolutions: 1e-7 degrees, 1 mm, 1 cm/s, 0.01 degrees.
    assert!((back.latitude_deg - position().latitude_deg).abs() < 0.6e-7);
    assert!((back.longitude_deg - position().longitude_deg).abs() < 0.6e-7);
    assert_eq!(back.altitude, position().altitude);
    assert!((back.velocity_ned_m_s - position().velocity_ned_m_s).norm() < 1e-9);
    assert!((back.heading_rad.unwrap() - std::f64::consts::FRAC_PI_2).abs() < 1e-4);
    assert_eq!(back.boot, position().boot);
}

#[test]
fn a_gnss_fix_comes_back_with_both_heights() {
    assert_eq!(
        through_the_wire(&gps_raw(&fix())).unwrap(),
        Telemetry::GpsRaw(fix())
    );
}

#[test]
fn what_the_receiver_does_not_know_stays_unknown() {
    let unknown = GpsRaw {
        place: fix().place.map(|place| GnssPlace {
            height: None,
            ..place
        }),
        horizontal_sigma_m: None,
        vertical_sigma_m: None,
        ground_speed_m_s: None,
        course_rad: None,
        satellites: None,
        ..fix()
    };
    assert_eq!(
        through_the_wire(&gps_raw(&unknown)).unwrap(),
        Telemetry::GpsRaw(unknown)
    );
}

#[test]
fn without_a_3d_fix_there_is_no_place_even_if_the_wire_has_one() {
    let two_d = GpsRaw {
        fix: GnssFix::Fix2d,
        ..fix()
    };
    let back = through_the_wire(&gps_raw(&two_d)).unwrap();
    assert_eq!(
        back,
        Telemetry::GpsRaw(GpsRaw {
            place: None,
            ..two_d
        })
    );
}

#[test]
fn impossible_positions_are_refused_by_name() {
    let refused = |change: fn(&mut GlobalPosition)| {
        let mut bad = position();
        change(&mut bad);
        through_the_wire(&global_position(&bad)).unwrap_err().name()
    };
    assert_eq!(
        refused(|p| (p.latitude_deg, p.longitude_deg) = (0.0, 0.0)),
        "null_position"
    );
    assert_eq!(refused(|p| p.latitude_deg = 90.5), "latitude");
    assert_eq!(refused(|p| p.latitude_deg = f64::MAX), "latitude");
    assert_eq!(refused(|p| p.longitude_deg = f64::MIN), "longitude");
    assert_eq!(
        refused(|p| p.altitude = MslAltitude::from_m(-1000.0)),
        "altitude"
    );
    assert_eq!(
        refused(|p| p.altitude = MslAltitude::from_m(f64::MAX)),
        "altitude"
    );
}

#[test]
fn an_attitude_keeps_its_nose_in_both_messages() {
    let sample = AttitudeSample {
        boot: BootTime::from_ms(77),
        attitude: Attitude::from_angles(0.1, -0.2, 2.5),
        rate_rad_s: Vector3::new(0.5, -0.25, 0.125),
        source: AttitudeSource::Quaternion,
    };
    for (message, source) in [
        (attitude_quaternion(&sample), AttitudeSource::Quaternion),
        (attitude(&sample), AttitudeSource::Angles),
    ] {
        let Telemetry::Attitude(back) = through_the_wire(&message).unwrap() else {
            panic!("not an attitude");
        };
        // Components travel as f32: 6e-8 relative.
        assert!(back.attitude.angle_to(&sample.attitude) < 1e-6);
        assert_eq!((back.rate_rad_s, back.source), (sample.rate_rad_s, source));
    }
}

#[test]
fn attitudes_that_are_none_are_refused() {
    let nan = dialect::ATTITUDE_DATA {
        roll: f32::NAN,
        ..Default::default()
    };
    assert_eq!(
        through_the_wire(&MavMessage::ATTITUDE(nan))
            .unwrap_err()
            .name(),
        "not_finite"
    );
    let zero = dialect::ATTITUDE_QUATERNION_DATA::default();
    let zero = MavMessage::ATTITUDE_QUATERNION(zero);
    assert_eq!(through_the_wire(&zero).unwrap_err().name(), "attitude");
}

#[test]
fn a_utc_of_the_year_2908_is_refused_and_said() {
    let claimed = SystemTime {
        boot: BootTime::from_ms(5),
        utc: None,
        claimed_utc_us: 29_600_000_000_000_000,
    };
    let Telemetry::SystemTime(back) = through_the_wire(&system_time(&claimed)).unwrap() else {
        panic!("not a time");
    };
    assert_eq!((back.utc, back.utc_is_absurd()), (None, true));
    let utc = ServiceTime::from_unix_ns(1_772_366_400_000_001_000);
    let good = SystemTime {
        utc: Some(utc),
        claimed_utc_us: 1_772_366_400_000_001,
        ..claimed
    };
    assert_eq!(
        through_the_wire(&system_time(&good)).unwrap(),
        Telemetry::SystemTime(good)
    );
}

#[test]
fn a_new_enum_value_is_an_error_and_not_silence() {
    let mut bytes = Encoder::new(Address::new(1, 1)).encode(&autopilot_heartbeat(true));
    bytes[14] = 250; // the vehicle type
    let (frame, _) = RawFrame::at_start(&bytes).unwrap();
    assert_eq!(decode(&frame).unwrap_err().name(), "undecodable");
}

#[test]
fn heartbeats_say_who_flies() {
    let flies = |message: &MavMessage| match through_the_wire(message).unwrap() {
        Telemetry::Heartbeat(heartbeat) => (heartbeat.is_autopilot(), heartbeat.armed),
        other => panic!("{other:?}"),
    };
    assert_eq!(flies(&autopilot_heartbeat(true)), (true, true));
    assert_eq!(flies(&companion_heartbeat(true)), (false, false));
}

#[test]
fn a_long_text_is_cut_at_a_characters_edge() {
    let text = format!("{}é and more", "x".repeat(STATUS_TEXT_BYTES - 1));
    let status = StatusText {
        severity: Severity::Alert,
        text,
    };
    let Telemetry::StatusText(back) = through_the_wire(&status_text(&status)).unwrap() else {
        panic!("not a text");
    };
    assert_eq!(back.text, "x".repeat(STATUS_TEXT_BYTES - 1));
    assert_eq!(back.severity, Severity::Alert);
}

#[test]
fn commands_and_their_answers_come_back() {
    let order = CommandInt {
        command: command::SPATIAL_USER_1,
        frame: 0,
        params: [7.0, 2.5, -1.0, 0.0],
        x: 314_094_222,
        y: -1_191_120_167,
        z: 12.5,
        target: Address::new(254, 191),
    };
    assert_eq!(
        through_the_wire(&command_int(&order).unwrap()).unwrap(),
        Telemetry::CommandInt(order)
    );
    let ack = CommandAck {
        command: command::SPATIAL_USER_1,
        result: CommandResult::Accepted,
        result_param2: 7,
        target: Address::new(1, 191),
    };
    assert_eq!(
        through_the_wire(&command_ack(&ack).unwrap()).unwrap(),
        Telemetry::CommandAck(ack)
    );
    assert!(
        command_ack(&CommandAck {
            command: 999_999,
            ..ack
        })
        .is_err()
    );
    let Telemetry::CommandLong(interval) =
        through_the_wire(&set_message_interval(Address::new(1, 1), 33, 50.0)).unwrap()
    else {
        panic!("not a command");
    };
    assert_eq!(
        (interval.command, interval.params[0], interval.params[1]),
        (511, 33.0, 20_000.0)
    );
}

#[test]
fn the_rest_comes_back_too() {
    let home = HomePosition {
        latitude_deg: 31.5,
        longitude_deg: -119.25,
        altitude: MslAltitude::from_m(10.5),
    };
    assert_eq!(
        through_the_wire(&home_position(&home)).unwrap(),
        Telemetry::HomePosition(home)
    );
    let status = EstimatorStatus {
        time: VehicleTime::Boot(BootTime::from_ms(5)),
        horizontal_sigma_m: Some(0.5),
        vertical_sigma_m: None,
        flags: EstimatorFlags::HEALTHY,
    };
    assert_eq!(
        through_the_wire(&estimator_status(&status)).unwrap(),
        Telemetry::EstimatorStatus(status)
    );
    let tracked = CameraTrackingGeoStatus {
        tracking: true,
        latitude_deg: 31.5,
        longitude_deg: 119.25,
        altitude: MslAltitude::from_m(10.5),
        horizontal_sigma_m: Some(1.5),
        vertical_sigma_m: Some(2.0),
        range_m: None,
    };
    assert_eq!(
        through_the_wire(&camera_tracking_geo_status(&tracked)).unwrap(),
        Telemetry::CameraTrackingGeoStatus(tracked)
    );
    let request = TimeSyncMessage {
        tc1_ns: 0,
        ts1_ns: 5,
        target: Address::new(1, 1),
    };
    let reply = through_the_wire(&timesync_reply(&request, Address::new(1, 191), 99)).unwrap();
    let expected = TimeSyncMessage {
        tc1_ns: 99,
        ts1_ns: 5,
        target: Address::new(1, 191),
    };
    assert_eq!(reply, Telemetry::TimeSync(expected));
}

#[test]
fn a_gimbal_without_yaw_flags_says_its_frame_by_its_lock() {
    use dialect::GimbalDeviceFlags as Flags;
    let yaw = |flags| {
        let message = dialect::GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
            q: [1.0, 0.0, 0.0, 0.0],
            angular_velocity_x: f32::NAN,
            flags,
            ..Default::default()
        };
        match through_the_wire(&MavMessage::GIMBAL_DEVICE_ATTITUDE_STATUS(message)).unwrap() {
            Telemetry::GimbalDeviceAttitude(gimbal) => {
                assert_eq!(gimbal.quaternion, UnitQuaternion::identity());
                assert_eq!(gimbal.rate_rad_s, None);
                gimbal.yaw
            }
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(yaw(Flags::empty()), crate::telemetry::GimbalYaw::FromNose);
    assert_eq!(
        yaw(Flags::GIMBAL_DEVICE_FLAGS_YAW_LOCK),
        crate::telemetry::GimbalYaw::FromNorth
    );
    assert_eq!(
        yaw(Flags::GIMBAL_DEVICE_FLAGS_YAW_LOCK | Flags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME),
        crate::telemetry::GimbalYaw::FromNose
    );
}
#[test]
fn a_gimbal_with_both_yaw_frames_is_refused_and_its_locks_do_not_turn_its_frame() {
    use dialect::GimbalDeviceErrorFlags as Faults;
    use dialect::GimbalDeviceFlags as Flags;
    let says = |flags, failure_flags, delta_yaw| {
        let message = dialect::GIMBAL_DEVICE_ATTITUDE_STATUS_DATA {
            q: [1.0, 0.0, 0.0, 0.0],
            flags,
            failure_flags,
            delta_yaw,
            gimbal_device_id: 2,
            ..Default::default()
        };
        match through_the_wire(&MavMessage::GIMBAL_DEVICE_ATTITUDE_STATUS(message)) {
            Ok(Telemetry::GimbalDeviceAttitude(gimbal)) => Ok(gimbal),
            Ok(other) => panic!("{other:?}"),
            Err(error) => Err(error.name()),
        }
    };
    let vehicle = Flags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME;
    let earth = Flags::GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME;
    let locks = Flags::GIMBAL_DEVICE_FLAGS_ROLL_LOCK | Flags::GIMBAL_DEVICE_FLAGS_PITCH_LOCK;
    let fine = Faults::empty();
    assert_eq!(says(vehicle | earth, fine, 0.5), Err("two_yaw_frames"));
    for flags in [vehicle, vehicle | locks] {
        let gimbal = says(flags, fine, 0.5).unwrap();
        assert_eq!(gimbal.yaw, crate::telemetry::GimbalYaw::FromNose);
        assert_eq!((gimbal.nose_rad, gimbal.device), (Some(0.5), 2));
    }
    // Without a frame flag the field is not to be read; not-a-number is unknown.
    assert_eq!(says(locks, fine, 0.5).unwrap().nose_rad, None);
    assert_eq!(says(earth, fine, f32::NAN).unwrap().nose_rad, None);
    let limit = Faults::GIMBAL_DEVICE_ERROR_FLAGS_AT_PITCH_LIMIT;
    assert!(!says(earth, limit, 0.5).unwrap().is_faulty);
    let encoder = Faults::GIMBAL_DEVICE_ERROR_FLAGS_ENCODER_ERROR;
    assert!(says(earth, encoder, 0.5).unwrap().is_faulty);
}

#[test]
fn a_second_receiver_is_read_like_the_first() {
    let message = dialect::GPS2_RAW_DATA {
        fix_type: dialect::GpsFixType::GPS_FIX_TYPE_3D_FIX,
        lat: 313_000_000,
        lon: 1_190_000_000,
        alt: 20_000,
        alt_ellipsoid: 31_000,
        h_acc: 900,
        ..Default::default()
    };
    let Ok(Telemetry::Gps2Raw(gps)) = through_the_wire(&MavMessage::GPS2_RAW(message)) else {
        panic!("not a second receiver");
    };
    let place = gps.place.unwrap();
    assert_eq!(
        place.height.unwrap() - place.altitude,
        emberfix_frames::GeoidUndulation::from_m(11.0)
    );
    assert_eq!(gps.horizontal_sigma_m, Some(0.9));
}
