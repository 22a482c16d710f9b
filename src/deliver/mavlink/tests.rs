use super::super::tests_support::alarm;
use super::*;
use crate::alarm::{AlarmClass, FireState};
use emberfix_frames::seconds;
use emberfix_mav::telemetry::CameraTrackingGeoStatus;
use emberfix_mav::{RawFrame, decode};

const OWN: Address = Address::new(1, 191);
const GROUND: Address = MavlinkSettings::GROUND;

fn start() -> ServiceTime {
    alarm(1, 1).properties.captured_at
}

fn after_s(s: f64) -> ServiceTime {
    start() + seconds(s)
}

fn delivery() -> MavlinkDelivery {
    MavlinkDelivery::new(MavlinkSettings::new(OWN))
}

/// The receipt that comes of it.
fn observe(
    delivery: &mut MavlinkDelivery,
    from: Address,
    telemetry: &Telemetry,
    now: ServiceTime,
) -> Option<Receipt> {
    delivery.observe(from, telemetry, now);
    let settled = std::mem::take(&mut delivery.settled);
    settled.into_iter().find_map(|settled| match settled {
        Settled::Delivered(receipt) => Some(receipt),
        _ => None,
    })
}

struct Sent {
    at_s: f64,
    bytes: usize,
    says: Telemetry,
}

/// Runs from one time to another in steps of 10 ms, and reads what was sent as a receiver would.
fn run(delivery: &mut MavlinkDelivery, from_s: f64, to_s: f64) -> Vec<Sent> {
    let mut encoder = Encoder::new(OWN);
    let steps = ((to_s - from_s) * 100.0).round() as u32;
    let mut sent = Vec::new();
    for step in 0..steps {
        let at_s = from_s + f64::from(step) * 0.01;
        while let Some(message) = delivery.poll(after_s(at_s)) {
            let bytes = encoder.encode(&message);
            let says = decode(&RawFrame::at_start(&bytes).unwrap().0).unwrap();
            sent.push(Sent {
                at_s,
                bytes: bytes.len(),
                says,
            });
        }
    }
    sent
}

fn texts(sent: &[Sent]) -> Vec<(f64, String)> {
    let text = |s: &Sent| match &s.says {
        Telemetry::StatusText(status) => {
            Some(((s.at_s * 10.0).round() / 10.0, status.text.clone()))
        }
        _ => None,
    };
    sent.iter().filter_map(text).collect()
}

fn commands(sent: &[Sent]) -> Vec<(f64, FireId, u32)> {
    let order = |s: &Sent| match &s.says {
        Telemetry::CommandInt(order) => {
            let told = spatial::decode(order).unwrap();
            assert_eq!(order.target, GROUND);
            Some((s.at_s.round(), told.fire, told.revision))
        }
        _ => None,
    };
    sent.iter().filter_map(order).collect()
}

fn ack(number: u32, revision: u32, result: CommandResult) -> Telemetry {
    Telemetry::CommandAck(CommandAck {
        command: command::SPATIAL_USER_1,
        result,
        result_param2: spatial::receipt(FireId(number), revision),
        target: OWN,
    })
}

#[test]
fn a_text_says_the_place_three_times_to_whoever_listens() {
    let mut delivery = delivery();
    delivery.offer(&alarm(7, 1)).unwrap();
    let said = texts(&run(&mut delivery, 0.0, 20.0));
    let times: Vec<f64> = said.iter().map(|(at_s, _)| *at_s).collect();
    assert_eq!(times.len(), 3);
    for (at_s, due_s) in times.iter().zip([0.0, 1.0, 3.0]) {
        assert!((at_s - due_s).abs() < 0.35, "{times:?}");
    }
    assert!(
        said.iter()
            .all(|(_, text)| text == "FIRE 7 31.409422,119.112017 +-3m 91%")
    );
}

#[test]
fn a_command_is_repeated_ever_slower_until_it_is_acknowledged() {
    let mut delivery = delivery();
    delivery.offer(&alarm(7, 1)).unwrap();
    let times: Vec<f64> = commands(&run(&mut delivery, 0.0, 100.0))
        .iter()
        .map(|(at_s, ..)| *at_s)
        .collect();
    assert_eq!(times, [0.0, 1.0, 3.0, 7.0, 15.0, 31.0, 61.0, 91.0]);
    let receipt = observe(
        &mut delivery,
        GROUND,
        &ack(7, 1, CommandResult::Accepted),
        after_s(100.0),
    );
    assert_eq!(
        receipt,
        Some(Receipt {
            id: "uav-1-7".to_owned(),
            revision: 1
        })
    );
    assert_eq!(commands(&run(&mut delivery, 100.0, 200.0)), []);
    assert_eq!((delivery.waiting(), delivery.counters().delivered), (0, 1));
}

#[test]
fn an_answer_ends_the_texts_but_one_is_said_in_any_case() {
    let mut delivery = delivery();
    delivery.offer(&alarm(7, 1)).unwrap();
    run(&mut delivery, 0.0, 0.01);
    observe(
        &mut delivery,
        GROUND,
        &ack(7, 1, CommandResult::Accepted),
        after_s(0.02),
    );
    assert_eq!(texts(&run(&mut delivery, 0.02, 10.0)).len(), 1);
}

#[test]
fn frames_keep_their_distance_and_their_share_of_the_link() {
    let mut delivery = delivery();
    for number in 1..=30 {
        delivery.offer(&alarm(number, 1)).unwrap();
    }
    let sent = run(&mut delivery, 0.0, 120.0);
    for pair in sent.windows(2) {
        assert!(pair[1].at_s - pair[0].at_s > 0.049);
    }
    for window_s in [10.0, 30.0, 119.0] {
        let bytes: usize = sent
            .iter()
            .filter(|s| s.at_s < window_s)
            .map(|s| s.bytes)
            .sum();
        assert!(
            bytes as f64 <= 240.0 + 120.0 * window_s,
            "{bytes} B in {window_s} s"
        );
    }
    let told: std::collections::BTreeSet<FireId> = commands(&sent)
        .into_iter()
        .map(|(_, fire, _)| fire)
        .collect();
    assert_eq!(told.len(), 30, "a busy link starves nobody");
}

#[test]
fn a_new_fire_overtakes_repetitions_and_texts() {
    let mut delivery = delivery();
    for number in 1..=30 {
        delivery.offer(&alarm(number, 1)).unwrap();
    }
    run(&mut delivery, 0.0, 20.0);
    delivery.offer(&alarm(99, 1)).unwrap();
    let first = commands(&run(&mut delivery, 20.0, 22.0));
    assert_eq!(first[0].1, FireId(99));
}

#[test]
fn a_refused_alarm_blocks_no_other() {
    let mut delivery = delivery();
    delivery.offer(&alarm(1, 1)).unwrap();
    delivery.offer(&alarm(2, 1)).unwrap();
    run(&mut delivery, 0.0, 0.6);
    assert_eq!(
        observe(
            &mut delivery,
            GROUND,
            &ack(1, 1, CommandResult::Denied),
            after_s(0.7)
        ),
        None
    );
    assert!(
        observe(
            &mut delivery,
            GROUND,
            &ack(2, 1, CommandResult::Accepted),
            after_s(0.7)
        )
        .is_some()
    );
    assert_eq!((delivery.waiting(), delivery.counters().refused), (1, 1));
    let again = commands(&run(&mut delivery, 0.7, 100.0));
    assert!(again.len() >= 5 && again.iter().all(|(_, fire, _)| *fire == FireId(1)));
}

#[test]
fn answers_that_take_their_time_cost_no_storm_of_repetitions() {
    let mut delivery = delivery();
    for number in 1..=20 {
        delivery.offer(&alarm(number, 1)).unwrap();
    }
    let mut on_the_way: Vec<(f64, FireId)> = Vec::new();
    for step in 0..6_000 {
        let now_s = f64::from(step) * 0.01;
        let sent = commands(&run(&mut delivery, now_s, now_s + 0.01));
        on_the_way.extend(sent.into_iter().map(|(_, fire, _)| (now_s + 0.8, fire)));
        let (come, wait) = on_the_way.into_iter().partition(|(at_s, _)| *at_s <= now_s);
        on_the_way = wait;
        for (_, fire) in come {
            let accepted = ack(fire.0, 1, CommandResult::Accepted);
            observe(&mut delivery, GROUND, &accepted, after_s(now_s));
        }
    }
    assert_eq!(
        (delivery.waiting(), delivery.counters().repetitions),
        (0, 0)
    );
}

#[test]
fn an_alarm_that_cannot_be_told_is_refused_and_blocks_no_other() {
    let mut delivery = delivery();
    let mut nameless = alarm(1, 1);
    nameless.properties.id = "nameless".to_owned();
    assert!(matches!(
        delivery.offer(&nameless),
        Err(MavlinkError::Spatial(_))
    ));
    delivery.offer(&alarm(2, 1)).unwrap();
    assert_eq!(commands(&run(&mut delivery, 0.0, 0.5)).len(), 1);
}

#[test]
fn an_answer_to_an_old_revision_does_not_deliver_the_new_one() {
    let mut delivery = delivery();
    delivery.offer(&alarm(7, 1)).unwrap();
    run(&mut delivery, 0.0, 0.5);
    delivery.offer(&alarm(7, 2)).unwrap();
    let late = observe(
        &mut delivery,
        GROUND,
        &ack(7, 1, CommandResult::Accepted),
        after_s(0.6),
    );
    assert_eq!((late, delivery.counters().stray_answers), (None, 1));
    assert_eq!(
        commands(&run(&mut delivery, 0.6, 2.0)),
        [(1.0, FireId(7), 2)]
    );
    let receipt = observe(
        &mut delivery,
        GROUND,
        &ack(7, 2, CommandResult::Accepted),
        after_s(2.0),
    );
    assert_eq!(receipt.map(|receipt| receipt.revision), Some(2));
}

#[test]
fn strangers_cannot_acknowledge() {
    let mut delivery = delivery();
    delivery.offer(&alarm(7, 1)).unwrap();
    run(&mut delivery, 0.0, 0.5);
    let accepted = ack(7, 1, CommandResult::Accepted);
    let stranger = observe(
        &mut delivery,
        Address::new(255, 190),
        &accepted,
        after_s(0.6),
    );
    assert_eq!((stranger, delivery.waiting()), (None, 1));
}

#[test]
fn what_waited_goes_within_two_seconds_of_the_grounds_return() {
    let mut delivery = delivery();
    delivery.offer(&alarm(7, 1)).unwrap();
    run(&mut delivery, 0.0, 70.0);
    let heartbeat = emberfix_mav::outgoing::companion_heartbeat(true);
    let bytes = Encoder::new(GROUND).encode(&heartbeat);
    let heartbeat = decode(&RawFrame::at_start(&bytes).unwrap().0).unwrap();
    observe(&mut delivery, GROUND, &heartbeat, after_s(70.0));
    assert_eq!(commands(&run(&mut delivery, 70.0, 72.0)).len(), 1);
}

#[test]
fn the_surest_fire_in_sight_is_the_cameras_target_once_a_second() {
    let mut delivery = delivery();
    let mut doubtful = alarm(1, 1);
    doubtful.properties.confidence = 0.6;
    delivery.offer(&doubtful).unwrap();
    delivery.offer(&alarm(2, 1)).unwrap();
    for number in [1, 2] {
        run(&mut delivery, f64::from(number), f64::from(number) + 1.0);
        observe(
            &mut delivery,
            GROUND,
            &ack(number, 1, CommandResult::Accepted),
            after_s(f64::from(number) + 1.0),
        );
    }
    let statuses: Vec<CameraTrackingGeoStatus> = run(&mut delivery, 10.0, 20.0)
        .into_iter()
        .filter_map(|s| match s.says {
            Telemetry::CameraTrackingGeoStatus(status) => Some(status),
            _ => None,
        })
        .collect();
    assert_eq!(statuses.len(), 10);
    assert!((statuses[0].horizontal_sigma_m.unwrap() - 2.5 / 2.146).abs() < 1e-3);
    assert_eq!(statuses[0].altitude.m(), 10.25);
    assert!(run(&mut delivery, 31.0, 60.0).is_empty(), "out of sight");
}

#[test]
fn a_fire_that_is_out_is_said_once_more_and_old_news_say_their_age() {
    let mut delivery = delivery();
    delivery.offer(&alarm(7, 1)).unwrap();
    run(&mut delivery, 0.0, 10.0);
    observe(
        &mut delivery,
        GROUND,
        &ack(7, 1, CommandResult::Accepted),
        after_s(10.0),
    );
    let mut out = alarm(7, 2);
    out.properties.state = FireState::Out;
    delivery.offer(&out).unwrap();
    let said = texts(&run(&mut delivery, 300.0, 320.0));
    assert_eq!(said.len(), 1);
    assert_eq!(said[0].1, "FIRE 7 OUT 31.409422,119.112017 +-3m 91% 5min");
}

#[test]
fn the_longest_text_keeps_its_coordinates() {
    let mut far = alarm(16_777_215, 1);
    far.properties.ce90_m = 12_345.6;
    far.properties.class = AlarmClass::Smoke;
    far.place = emberfix_frames::place_from_degrees(
        -31.409_422,
        -119.112_017,
        emberfix_frames::EllipsoidHeight::from_m(0.0),
    )
    .unwrap();
    let mut delivery = delivery();
    delivery.offer(&far).unwrap();
    let said = texts(&run(&mut delivery, 0.0, 2.0));
    assert!(
        said[0]
            .1
            .starts_with("SMOKE 16777215 -31.409422,-119.112017 +-12346m")
    );
    assert!(said[0].1.len() <= 50);
}

#[test]
fn more_fires_than_room_wait_in_the_outbox_until_some_are_delivered() {
    let mut delivery = delivery();
    let limit = u32::try_from(MavlinkDelivery::MAX_FIRES).unwrap();
    for number in 1..=limit {
        delivery.offer(&alarm(number, 1)).unwrap();
    }
    let refused = delivery.offer(&alarm(limit + 1, 1));
    assert_eq!(
        refused,
        Err(MavlinkError::Full {
            limit: MavlinkDelivery::MAX_FIRES
        })
    );
    let first = commands(&run(&mut delivery, 0.0, 0.5))[0].1;
    observe(
        &mut delivery,
        GROUND,
        &ack(first.0, 1, CommandResult::Accepted),
        after_s(0.6),
    );
    assert_eq!(delivery.offer(&alarm(limit + 1, 1)), Ok(()));
}

fn radio(free_buffer_percent: u8) -> Telemetry {
    Telemetry::RadioStatus(emberfix_mav::telemetry::RadioStatus {
        rssi: None,
        remote_rssi: None,
        free_buffer_percent,
        receive_errors: 0,
    })
}

#[test]
fn a_radio_whose_buffer_fills_slows_us_and_an_empty_one_lets_us_go_on() {
    const RADIO: Address = Address::new(51, 68);
    let sent_in_a_minute = |free: Option<u8>| {
        let mut delivery = delivery();
        for number in 1..=100 {
            delivery.offer(&alarm(number, 1)).unwrap();
        }
        run(&mut delivery, 0.0, 10.0);
        let mut bytes = 0;
        for second in 10..70 {
            let from_s = f64::from(second);
            if let Some(free) = free {
                observe(&mut delivery, RADIO, &radio(free), after_s(from_s));
            }
            let sent = run(&mut delivery, from_s, from_s + 1.0);
            bytes += sent.iter().map(|sent| sent.bytes).sum::<usize>();
        }
        bytes
    };
    let (free, full) = (sent_in_a_minute(Some(100)), sent_in_a_minute(Some(10)));
    assert_eq!(free, sent_in_a_minute(None));
    assert!(full < free / 5 && full > 400, "{full} of {free} bytes");
}

#[test]
fn what_an_operator_has_seen_is_not_repeated_and_what_was_dismissed_not_shown() {
    let said = |attention| {
        let mut delivery = delivery();
        delivery.offer(&alarm(7, 1)).unwrap();
        let mut sent = run(&mut delivery, 0.0, 0.5);
        delivery.attend(|_| attention);
        sent.extend(run(&mut delivery, 0.5, 20.0));
        let camera = |sent: &&Sent| matches!(sent.says, Telemetry::CameraTrackingGeoStatus(_));
        (texts(&sent).len(), sent.iter().filter(camera).count() > 3)
    };
    assert_eq!(said(Attention::Wanted), (3, true));
    assert_eq!(said(Attention::Seen), (1, true));
    assert_eq!(said(Attention::Dismissed), (1, false));
}
