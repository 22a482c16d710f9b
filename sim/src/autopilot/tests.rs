//! The autopilot against what PX4 does.

use super::*;
use crate::flight::{FlightConfig, GustConfig, Nose, PathConfig};
use emberfix_mav::telemetry::Telemetry;
use emberfix_mav::{FrameReader, SystemId};

const DATUM: Lla = Lla {
    latitude_deg: 31.409422,
    longitude_deg: 119.112017,
    height_m: 11.0,
};

/// Clockwise from the circle's north, nose along the course: at time zero due east, 30 m up.
fn flight() -> Arc<Flight> {
    let config = FlightConfig {
        duration_s: 30.0,
        path: PathConfig::Orbit {
            centre_m: [0.0, -200.0],
            radius_m: 200.0,
            height_above_ground_m: 30.0,
            speed_m_s: 8.0,
            start_azimuth_deg: 0.0,
            clockwise: true,
            nose: Nose::Course,
        },
        gusts: GustConfig::calm(),
    };
    Arc::new(Flight::new(&config, 1, |_, _| 0.0))
}

fn autopilot() -> Autopilot {
    Autopilot::new(&AutopilotSetup {
        flight: flight(),
        datum: DATUM,
        system_id: 7,
        config: &AutopilotConfig {
            undulation_m: Some(2.355),
            ..AutopilotConfig::default()
        },
        errors: &ErrorsConfig::default().sensors_off(),
        seed: 5,
        start: ServiceTime::from_unix_ns(1_772_337_600_000_000_000),
        from_s: 0.0,
    })
}

fn heard(autopilot: &mut Autopilot, until_s: f64) -> Vec<Telemetry> {
    let mut reader = FrameReader::new();
    let mut telemetry = Vec::new();
    for outgoing in autopilot.take_due(until_s) {
        reader.push(&outgoing.bytes);
        while let Some(received) = reader.next_received() {
            assert_eq!(received.frame.sender(), Address::new(7, 1));
            telemetry.push(received.telemetry.unwrap());
        }
    }
    telemetry
}

fn from_service(message: &MavMessage) -> RawFrame {
    let sender = Address {
        system: SystemId(7),
        component: ComponentId::ONBOARD_COMPUTER,
    };
    let mut reader = FrameReader::new();
    reader.push(&Encoder::new(sender).encode(message));
    reader.next_frame().unwrap()
}

fn count(telemetry: &[Telemetry], wanted: impl Fn(&Telemetry) -> bool) -> usize {
    telemetry.iter().filter(|message| wanted(message)).count()
}

#[test]
fn messages_come_at_the_rates_of_the_onboard_profile() {
    let telemetry = heard(&mut autopilot(), 10.0);
    // One less or more at the ends of 10 s.
    assert!((499..=501).contains(&count(&telemetry, |m| matches!(m, Telemetry::Attitude(_)))));
    assert!((499..=501).contains(&count(&telemetry, |m| matches!(
        m,
        Telemetry::GlobalPosition(_)
    ))));
    assert!((49..=51).contains(&count(&telemetry, |m| matches!(m, Telemetry::GpsRaw(_)))));
    assert!((9..=11).contains(&count(&telemetry, |m| matches!(m, Telemetry::Heartbeat(_)))));
    assert!((99..=101).contains(&count(&telemetry, |m| matches!(m, Telemetry::TimeSync(_)))));
}

#[test]
fn a_nose_due_east_is_told_as_ninety_degrees_banked_right() {
    let telemetry = heard(&mut autopilot(), 0.1);
    let first = telemetry.iter().find_map(|message| match message {
        Telemetry::Attitude(sample) => Some(sample.attitude.angles()),
        _ => None,
    });
    let (roll, _, heading) = first.unwrap();
    // 0.3 degrees: 20 ms of turning at 2.3 degrees/s, and the frame's own rounding.
    assert!(
        (heading.to_degrees() - 90.0).abs() < 0.3,
        "{}",
        heading.to_degrees()
    );
    // tan(bank) = v^2 / (g R): 1.87 degrees.
    assert!(
        (roll.to_degrees() - 1.87).abs() < 0.1,
        "{}",
        roll.to_degrees()
    );
}

#[test]
fn altitudes_are_above_the_sea_and_the_receiver_says_the_ellipsoid_too() {
    let telemetry = heard(&mut autopilot(), 1.0);
    for message in &telemetry {
        match message {
            // 1 cm: the Earth falls 3 mm beneath the plane at 200 m; millimetres on the wire.
            Telemetry::GlobalPosition(position) => {
                assert!((position.altitude.m() - (41.0 - 2.355)).abs() < 0.01);
                assert!((position.above_home_m - 30.0).abs() < 0.01);
            }
            Telemetry::GpsRaw(raw) => {
                let place = raw.place.unwrap();
                let undulation = place.height.unwrap() - place.altitude;
                assert!((undulation.m() - 2.355).abs() < 0.002);
            }
            _ => {}
        }
    }
}

#[test]
fn timesync_answers_mirror_the_question_and_carry_a_clock_that_counts_from_boot() {
    let mut autopilot = autopilot();
    heard(&mut autopilot, 4.999);
    let request = outgoing::timesync_request(Address::new(7, 1), 123_456_789);
    autopilot.receive(5.0, &from_service(&request));
    let answers: Vec<_> = heard(&mut autopilot, 5.1)
        .into_iter()
        .filter_map(|message| match message {
            Telemetry::TimeSync(sync) if !sync.is_request() => Some(sync),
            _ => None,
        })
        .collect();
    assert_eq!(answers.len(), 1);
    assert_eq!(answers[0].ts1_ns, 123_456_789);
    // Booted 212.4 s before the start, 12 ppm fast: 217.40006 s.
    assert!(
        (answers[0].tc1_ns - 217_400_060_000).abs() < 1_000,
        "{}",
        answers[0].tc1_ns
    );
    assert_eq!(autopilot.heard().timesync_requests, 1);
}

#[test]
fn message_intervals_are_acknowledged_and_obeyed_and_unknown_ones_refused() {
    let mut autopilot = autopilot();
    let me = Address::new(7, 1);
    heard(&mut autopilot, 1.0);
    let slower = outgoing::set_message_interval(me, message_id::ATTITUDE_QUATERNION, 10.0);
    let unknown =
        outgoing::set_message_interval(me, message_id::GIMBAL_DEVICE_ATTITUDE_STATUS, 10.0);
    autopilot.receive(1.0, &from_service(&slower));
    autopilot.receive(1.0, &from_service(&unknown));
    let telemetry = heard(&mut autopilot, 3.0);
    let results: Vec<_> = telemetry
        .iter()
        .filter_map(|message| match message {
            Telemetry::CommandAck(ack) => Some(ack.result),
            _ => None,
        })
        .collect();
    assert!(results.contains(&CommandResult::Accepted), "{results:?}");
    assert!(results.contains(&CommandResult::Unsupported), "{results:?}");
    let attitudes = count(&telemetry, |m| matches!(m, Telemetry::Attitude(_)));
    assert!(
        (19..=21).contains(&attitudes),
        "{attitudes} in 2 s at 10 Hz"
    );
}
