//! The rules of the screens, without sockets and without a clock.

use super::cap::{self, CapConfig, Heading, Issued, Kind, Status, Stood};
use super::cot::{self, Profile, Telling};
use super::told::{Rhythm, Told, Word};
use super::{kml, view};
use crate::alarm::{Alarm, FireState};
use crate::ground::incident::{Circumstances, Incident, Operator, OperatorState, Part};
use emberfix_frames::{ServiceTime, SignedDuration};
use std::sync::Arc;

const ALARM: &str = r#"{"type":"Feature","geometry":{"type":"Point","coordinates":[119.112017,31.409422,18.5]},
    "properties":{"id":"uav-1-7","revision":1,"uav":"uav-1","class":"fire","state":"confirmed",
    "confidence":0.93,"first_seen_at":"2026-03-01T12:00:00Z","captured_at":"2026-03-01T12:00:10Z",
    "altitude_msl_m":10.1,"height_above_ground_m":null,"ce90_m":2.6,"le90_m":2.1,
    "covariance_enu_m2":[1.6,0.3,0,0.3,1.3,0,0,0,1.6],"methods":["stereo"],"sightings":5,"range_m":22.4,
    "size_m":null,"trend":null,"degraded":[]}}"#;

/// Seconds after the alarm was captured.
fn at(seconds: i64) -> ServiceTime {
    captured() + SignedDuration::from_secs(seconds)
}

fn captured() -> ServiceTime {
    ServiceTime::from_rfc3339("2026-03-01T12:00:10Z").unwrap()
}

fn incident(row: i64, operator: OperatorState, change: impl FnOnce(&mut Alarm)) -> Arc<Incident> {
    let mut alarm = Alarm::from_geojson(ALARM.as_bytes()).unwrap();
    change(&mut alarm);
    let operator = Operator {
        state: operator,
        by: (operator != OperatorState::New).then(|| "Ana".to_owned()),
        ..Operator::default()
    };
    let part = Part {
        alarm: &alarm,
        operator: &operator,
        aircraft_knows: None,
    };
    let about = Circumstances {
        id: alarm.properties.id.clone(),
        row,
        history: 1,
        chip: false,
        exercise: false,
    };
    Arc::new(Incident::of(&[part], about).unwrap())
}

const RHYTHM: Rhythm = Rhythm {
    repeat: SignedDuration::from_secs(60),
    farewells: 2,
    forget: SignedDuration::from_secs(600),
};

fn words(told: &mut Told, incidents: &[Arc<Incident>], now: ServiceTime) -> Vec<&'static str> {
    let due = told.due(incidents, now, RHYTHM);
    due.iter().for_each(|word| told.said(word, now));
    due.iter()
        .map(|word| match word {
            Word::Stands(_) => "stands",
            Word::Gone(_) => "gone",
        })
        .collect()
}

#[test]
fn a_receiver_hears_news_once_and_the_rest_now_and_then() {
    let mut told = Told::default();
    let first = [incident(1, OperatorState::New, |_| {})];
    assert_eq!(words(&mut told, &first, at(0)), ["stands"]);
    assert!(words(&mut told, &first, at(1)).is_empty());
    let second = [incident(2, OperatorState::New, |_| {})];
    assert_eq!(words(&mut told, &second, at(2)), ["stands"]);
    assert_eq!(
        words(&mut told, &second, at(62)),
        ["stands"],
        "who came later sees it too"
    );
}

#[test]
fn what_is_dismissed_or_merged_is_taken_off_the_map_even_after_a_restart() {
    let mut told = Told::default();
    words(&mut told, &[incident(1, OperatorState::New, |_| {})], at(0));
    let dismissed = [incident(2, OperatorState::Dismissed, |_| {})];
    assert_eq!(words(&mut told, &dismissed, at(5)), ["gone"]);
    assert_eq!(
        words(&mut told, &dismissed, at(6)),
        ["gone"],
        "a datagram may be lost"
    );
    assert!(words(&mut told, &dismissed, at(7)).is_empty());
    let back = [incident(3, OperatorState::Acknowledged, |_| {})];
    assert_eq!(
        words(&mut told, &back, at(8)),
        ["stands"],
        "the dismissal was taken back"
    );
    assert_eq!(
        words(&mut told, &[], at(9)),
        ["gone"],
        "it went into another incident"
    );

    let mut anew = Told::default();
    assert_eq!(
        words(&mut anew, &dismissed, at(10)),
        ["gone"],
        "somebody may still show it"
    );
    assert!(words(&mut anew.clone(), &dismissed, at(700)).len() <= 1);
    assert!(
        words(&mut Told::default(), &dismissed, at(700)).is_empty(),
        "its marker has gone stale"
    );
}

#[test]
fn what_has_gone_out_is_shown_a_while_and_then_let_go_stale() {
    let out = [incident(1, OperatorState::New, |alarm| {
        alarm.properties.state = FireState::Out
    })];
    assert_eq!(words(&mut Told::default(), &out, at(10)), ["stands"]);
    assert!(words(&mut Told::default(), &out, at(601)).is_empty());
}

#[test]
fn an_event_keeps_its_uid_and_its_deletion_names_it() {
    let telling = Telling {
        profile: Profile::Marker,
        now: at(0),
        stale: SignedDuration::from_secs(600),
    };
    let event = cot::event(&incident(1, OperatorState::New, |_| {}), &telling);
    for part in [
        "uid=\"emberfix.uav-1-7\"",
        "type=\"a-u-G\"",
        "stale=\"2026-03-01T12:10:10.000Z\"",
        "lat=\"31.4094220\"",
        "hae=\"18.5\"",
        "ce=\"2.6\"",
        "le=\"2.1\"",
        "90 % of cases",
    ] {
        assert!(event.contains(part), "{part} is not in {event}");
    }
    let deletion = cot::deletion("uav-1-7", &telling);
    assert!(
        deletion.contains("type=\"t-x-d-d\"") && deletion.contains("<__forcedelete/>"),
        "{deletion}"
    );
    assert_eq!(deletion.matches("emberfix.uav-1-7").count(), 2);
}

fn issued(kind: Kind, incident: &Incident, sent: ServiceTime) -> Issued {
    Issued {
        kind,
        sent,
        stood: Stood::of(incident),
        references: vec!["a,b,c".to_owned()],
    }
}

#[test]
fn cap_tells_what_is_news_and_no_more() {
    let new = incident(1, OperatorState::New, |_| {});
    assert_eq!(cap::due(&new, None, at(0)), Some(Kind::Alert));
    let suspected = incident(1, OperatorState::New, |alarm| {
        alarm.properties.state = FireState::Suspected
    });
    assert_eq!(cap::due(&suspected, None, at(0)), None, "not yet");
    let dismissed = incident(2, OperatorState::Dismissed, |_| {});
    assert_eq!(
        cap::due(&dismissed, None, at(0)),
        None,
        "nobody was told of it"
    );

    let alert = issued(Kind::Alert, &new, at(0));
    assert_eq!(cap::due(&new, Some(&alert), at(30)), None);
    let growing = incident(3, OperatorState::New, |alarm| {
        alarm.properties.state = FireState::Growing
    });
    assert_eq!(
        cap::due(&growing, Some(&alert), at(30)),
        None,
        "at most once a minute"
    );
    assert_eq!(cap::due(&growing, Some(&alert), at(61)), Some(Kind::Update));
    let confirmed = incident(4, OperatorState::Confirmed, |_| {});
    assert_eq!(
        cap::due(&confirmed, Some(&alert), at(1)),
        Some(Kind::Update),
        "a person said so"
    );
    assert_eq!(
        cap::due(&dismissed, Some(&alert), at(1)),
        Some(Kind::Cancel)
    );
    assert_eq!(
        cap::due(&new, Some(&alert), at(1_801)),
        Some(Kind::Update),
        "or it would expire"
    );
    let cancel = issued(Kind::Cancel, &dismissed, at(2));
    assert_eq!(cap::due(&dismissed, Some(&cancel), at(3)), None);
    assert_eq!(
        cap::due(&new, Some(&cancel), at(4)),
        Some(Kind::Alert),
        "the dismissal was taken back"
    );
}

#[test]
fn an_exercise_is_never_told_in_earnest() {
    let mut exercise = (*incident(1, OperatorState::New, |_| {})).clone();
    exercise.exercise = true;
    let config = CapConfig {
        sender: "ground@brigade.example".to_owned(),
        sender_name: None,
        status: Status::Actual,
        radius_m: 500.0,
    };
    let heading = Heading {
        identifier: "x.1",
        earlier: &[],
        sent: at(0),
    };
    let text = cap::message(Kind::Alert, &exercise, heading, &config);
    assert!(text.contains("<status>Exercise</status>"), "{text}");
    assert!(view::callsign(&exercise).starts_with("EXERCISE "));
}

#[test]
fn an_ellipse_at_the_date_line_and_an_aircraft_with_a_strange_name_make_sound_kml() {
    let far = incident(1, OperatorState::New, |alarm| {
        alarm.place = emberfix_frames::place_from_degrees(
            -16.5,
            179.99999,
            emberfix_frames::EllipsoidHeight::from_m(3.0),
        )
        .unwrap();
        alarm.properties.uav = "<b>&\u{7}".to_owned();
    });
    let rings = view::ellipse90(&far, 16);
    assert_eq!(rings.len(), 2, "one on each side of the line");
    for ring in &rings {
        assert_eq!(ring.first(), ring.last(), "closed");
        let west = ring.iter().all(|[lon, _]| (-180.0..-179.0).contains(lon));
        let east = ring.iter().all(|[lon, _]| (179.0..=180.0).contains(lon));
        assert!(west || east, "{ring:?}");
    }
    let text = kml::document(&[far], &[], "http://localhost", at(0));
    assert_eq!(text.matches("<Polygon>").count(), 2, "{text}");
    assert!(!text.contains("<b>") && !text.contains('\u{7}'), "{text}");
}
