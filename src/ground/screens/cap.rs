//! Common Alerting Protocol 1.2 (OASIS, 2010): one chain of messages per incident.
//!
//! **In:** an [`Incident`] and what was issued of it before. **Out:** an `Alert`, then `Update`s and in
//! the end a `Cancel` that refer to all before them. Altitudes in CAP are feet above mean sea level.
//!
//! A machine's detection is never `Public`: it goes to the addresses that an operator passes it on
//! to (`Restricted`). `certainty` is `Likely` until a person confirms, then `Observed`. The circle
//! is the area to be told, not the error of the position, which stands in the parameters.

use super::view;
use super::xml::Element;
use crate::alarm::{AlarmClass, FireState};
use crate::ground::incident::{Incident, OperatorState};
use emberfix_frames::{
    EllipsoidHeight, ServiceTime, SignedDuration, Wgs84Parts, enu_offset, place_from_degrees,
};
use serde::{Deserialize, Serialize};

const NAMESPACE: &str = "urn:oasis:names:tc:emergency:cap:1.2";
const FEET_PER_METRE: f64 = 1.0 / 0.3048;
/// How long a message holds when nothing follows it.
const HOLDS: SignedDuration = SignedDuration::from_hours(1);
/// Two updates are at least so far apart, unless a person decided something.
const LEAST: SignedDuration = SignedDuration::from_secs(60);
/// After so long without news a message is renewed, so that it does not expire while it burns.
const RENEW: SignedDuration = SignedDuration::from_mins(30);
/// Share of the told CE90 by which a place must move to be told again.
const MOVED: f64 = 1.0;
/// Earlier messages that one refers to, at most: the first and the latest ones.
const MAX_REFERENCES: usize = 32;

/// What the ground configuration says.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::ground) struct CapConfig {
    /// Who speaks; unique, without spaces.
    pub sender: String,
    /// For people.
    pub sender_name: Option<String>,
    pub status: Status,
    /// Radius of the area to be told, metres, beside what the fire covers.
    pub radius_m: f64,
}

/// Whether it is in earnest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::ground) enum Status {
    Actual,
    Exercise,
    Test,
}

impl Status {
    /// As the configuration writes it.
    pub(super) fn named(name: &str) -> Option<Self> {
        match name {
            "actual" => Some(Self::Actual),
            "exercise" => Some(Self::Exercise),
            "test" => Some(Self::Test),
            _ => None,
        }
    }

    fn word(self) -> &'static str {
        match self {
            Self::Actual => "Actual",
            Self::Exercise => "Exercise",
            Self::Test => "Test",
        }
    }
}

/// Kind of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Alert,
    Update,
    Cancel,
}

impl Kind {
    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Alert => "Alert",
            Self::Update => "Update",
            Self::Cancel => "Cancel",
        }
    }

    pub(super) fn named(word: &str) -> Option<Self> {
        [Self::Alert, Self::Update, Self::Cancel]
            .into_iter()
            .find(|kind| kind.word() == word)
    }
}

/// How an incident stood when it was told: as much as decides whether it is news.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Stood {
    state: FireState,
    class: AlarmClass,
    latitude_deg: f64,
    longitude_deg: f64,
    ce90_m: f64,
    certainty: String,
    is_open: bool,
}

impl Stood {
    pub(super) fn of(incident: &Incident) -> Self {
        let [longitude_deg, latitude_deg, _] = incident.coordinates();
        Self {
            state: incident.state,
            class: incident.class,
            latitude_deg,
            longitude_deg,
            ce90_m: incident.ce90_m,
            certainty: certainty(incident).to_owned(),
            is_open: view::is_open(incident),
        }
    }

    /// A person decided, or the fire ended: told at once.
    fn is_decided_since(&self, now: &Self) -> bool {
        self.certainty != now.certainty || self.is_open != now.is_open
    }

    fn is_changed_since(&self, now: &Self) -> bool {
        self.state != now.state
            || self.class != now.class
            || self.moved_m(now) > MOVED * self.ce90_m
    }

    fn moved_m(&self, now: &Self) -> f64 {
        let place = |stood: &Self| {
            place_from_degrees(
                stood.latitude_deg,
                stood.longitude_deg,
                EllipsoidHeight::from_m(0.0),
            )
        };
        match (place(self), place(now)) {
            (Ok(before), Ok(after)) => enu_offset(&before, &after).xy().norm(),
            _ => 0.0,
        }
    }
}

/// What was issued of an incident last, and the names of all before.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Issued {
    pub kind: Kind,
    pub sent: ServiceTime,
    pub stood: Stood,
    /// `sender,identifier,sent` of every message of this incident, oldest first.
    pub references: Vec<String>,
}

/// What should be issued now, if anything.
pub(super) fn due(incident: &Incident, issued: Option<&Issued>, now: ServiceTime) -> Option<Kind> {
    let is_certain = incident.state != FireState::Suspected
        || incident.operator.state == OperatorState::Confirmed;
    let is_told = view::is_open(incident) && is_certain;
    let Some(issued) = issued else {
        return is_told.then_some(Kind::Alert);
    };
    if !view::is_shown(incident) {
        return (issued.kind != Kind::Cancel).then_some(Kind::Cancel);
    }
    if issued.kind == Kind::Cancel {
        return is_told.then_some(Kind::Alert);
    }
    let (since, stands) = (now - issued.sent, Stood::of(incident));
    let is_news = issued.stood.is_decided_since(&stands)
        || since >= LEAST && issued.stood.is_changed_since(&stands)
        || since >= RENEW && stands.is_open;
    is_news.then_some(Kind::Update)
}

/// Name and time of a message, and the names of those before it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Heading<'a> {
    /// Given once, never again.
    pub identifier: &'a str,
    pub earlier: &'a [String],
    pub sent: ServiceTime,
}

/// A message of how an incident stands.
pub(super) fn message(
    kind: Kind,
    incident: &Incident,
    heading: Heading<'_>,
    config: &CapConfig,
) -> String {
    let by = incident.operator.by.as_deref().unwrap_or("an operator");
    let note = (kind == Kind::Cancel).then(|| format!("Dismissed by {by}: no fire."));
    envelope(kind, status(incident, config), heading, config)
        .children(note.map(|note| Element::leaf("note", note)))
        .children(references(heading.earlier))
        .field("incidents", token(&incident.id))
        .child(info(kind, incident, config, heading.sent))
        .document()
}

/// The `Cancel` of an incident that went into another; what there is to know stands there.
pub(super) fn merged(
    id: &str,
    heir: &Incident,
    heading: Heading<'_>,
    config: &CapConfig,
) -> String {
    let note = format!("The same fire as {}, under which it goes on.", heir.id);
    envelope(Kind::Cancel, status(heir, config), heading, config)
        .field("note", note)
        .children(references(heading.earlier))
        .field(
            "incidents",
            format_args!("{} {}", token(id), token(&heir.id)),
        )
        .document()
}

/// As far as `restriction`, which all messages share.
fn envelope(kind: Kind, status: Status, heading: Heading<'_>, config: &CapConfig) -> Element {
    Element::new("alert")
        .with("xmlns", NAMESPACE)
        .field("identifier", heading.identifier)
        .field("sender", &config.sender)
        .field("sent", time(heading.sent))
        .field("status", status.word())
        .field("msgType", kind.word())
        .field("source", "emberfix")
        .field("scope", "Restricted")
        .field(
            "restriction",
            "Detected by a machine. For fire services; not for the public before a person decides so.",
        )
}

/// How a later message refers to this one.
pub(super) fn reference(sender: &str, identifier: &str, sent: ServiceTime) -> String {
    format!("{sender},{identifier},{}", time(sent))
}

/// A name that CAP allows: no white space, commas or markup.
pub(super) fn token(text: &str) -> String {
    let safe = |c: char| {
        if c.is_ascii_alphanumeric() || matches!(c, '-' | '.' | '_') {
            c
        } else {
            '_'
        }
    };
    text.chars().map(safe).collect()
}

fn references(earlier: &[String]) -> Option<Element> {
    let (first, rest) = earlier.split_first()?;
    let latest = &rest[rest.len().saturating_sub(MAX_REFERENCES - 1)..];
    let all: Vec<&str> = std::iter::once(first)
        .chain(latest)
        .map(String::as_str)
        .collect();
    Some(Element::leaf("references", all.join(" ")))
}

/// While people train, nothing is in earnest.
fn status(incident: &Incident, config: &CapConfig) -> Status {
    match config.status {
        Status::Actual if incident.exercise => Status::Exercise,
        status => status,
    }
}

fn certainty(incident: &Incident) -> &'static str {
    match incident.operator.state {
        OperatorState::Confirmed => "Observed",
        OperatorState::Dismissed => "Unlikely",
        OperatorState::New | OperatorState::Acknowledged => "Likely",
    }
}

fn info(kind: Kind, incident: &Incident, config: &CapConfig, now: ServiceTime) -> Element {
    let is_over = kind == Kind::Cancel || incident.state == FireState::Out;
    let (response, urgency, severity) = match (is_over, incident.operator.state) {
        (true, _) => ("AllClear", "Past", "Minor"),
        (false, OperatorState::Confirmed) => ("Execute", "Immediate", "Severe"),
        (false, _) => ("Assess", "Immediate", "Unknown"),
    };
    let onset = if is_over {
        None
    } else {
        Some(Element::leaf("onset", time(incident.first_seen_at)))
    };
    Element::new("info")
        .field("language", "en")
        .field("category", "Fire")
        .field("event", "Fire detected by UAV")
        .field("responseType", response)
        .field("urgency", urgency)
        .field("severity", severity)
        .field("certainty", certainty(incident))
        .field("effective", time(now))
        .children(onset)
        .field("expires", time(now + HOLDS))
        .children(
            config
                .sender_name
                .as_ref()
                .map(|name| Element::leaf("senderName", name)),
        )
        .field("headline", headline(kind, incident))
        .field("description", view::lines(incident).join(". "))
        .children(parameters(incident))
        .child(area(incident, config))
}

fn headline(kind: Kind, incident: &Incident) -> String {
    match kind {
        Kind::Cancel => format!("Cancelled: {}", view::callsign(incident)),
        Kind::Alert | Kind::Update => format!("{} ({})", view::title(incident), incident.id),
    }
}

fn parameters(incident: &Incident) -> Vec<Element> {
    let mut parameters = vec![
        ("emberfix:incident", incident.id.clone()),
        ("emberfix:ce90_m", format!("{:.1}", incident.ce90_m)),
        ("emberfix:le90_m", format!("{:.1}", incident.le90_m)),
        ("emberfix:confidence", format!("{:.2}", incident.confidence)),
        ("emberfix:captured_at", incident.captured_at.rfc3339()),
        (
            "emberfix:height_ellipsoid_m",
            format!("{:.1}", incident.place.height().m()),
        ),
        (
            "emberfix:altitude_msl_m",
            format!("{:.1}", incident.altitude_msl_m),
        ),
    ];
    parameters.extend(
        incident
            .aircraft()
            .map(|uav| ("emberfix:uav", uav.to_owned())),
    );
    let element = |(name, value): (&'static str, String)| {
        Element::new("parameter")
            .field("valueName", name)
            .field("value", value)
    };
    parameters.into_iter().map(element).collect()
}

fn area(incident: &Incident, config: &CapConfig) -> Element {
    let [lon, lat, _] = incident.coordinates();
    let fire_m = incident.size_m.map_or(0.0, |size| 0.5 * size.width);
    let radius_km = (config.radius_m + incident.ce90_m + fire_m) / 1000.0;
    Element::new("area")
        .field(
            "areaDesc",
            format_args!("{:.0} m around {lat:.5}, {lon:.5}", 1000.0 * radius_km),
        )
        .field("circle", format_args!("{lat:.6},{lon:.6} {radius_km:.3}"))
        .field(
            "altitude",
            format_args!("{:.0}", incident.altitude_msl_m * FEET_PER_METRE),
        )
}

/// CAP writes seconds without fraction, and UTC as `-00:00`, never `Z` (section 3.3.2).
fn time(at: ServiceTime) -> String {
    let text = at.rfc3339();
    format!("{}-00:00", text.get(..19).unwrap_or(&text))
}
