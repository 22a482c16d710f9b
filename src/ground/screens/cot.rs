//! Cursor on Target: what ATAK, WinTAK and TAK servers show.
//!
//! **In:** an [`Incident`]. **Out:** one XML event (protocol version 0, which every client has to
//! accept). Heights are above the WGS84 ellipsoid (`hae`), metres.
//!
//! `ce` and `le` hold **90 %**, as the alarm's CE90 and LE90 do, and the remarks say so. (The
//! schema of CoT calls them one sigma where they are errors at all; clients print them as "CE" and
//! "LE", which people read as 90 %. The larger of the two readings is the safe one.)
//!
//! An incident keeps its uid over all updates, restarts and merges; what is dismissed or merged
//! away is deleted by a `t-x-d-d` event of the same uid.

use super::view;
use super::xml::Element;
use crate::alarm::{AlarmClass, FireState};
use crate::ground::incident::{Incident, OperatorState};
use emberfix_frames::{ServiceTime, SignedDuration, Wgs84Parts};

/// A fire engine's badge in the set of icons that every TAK client ships.
const ICON: &str = "f7f71666-8b28-4b57-9fbb-e38e61d33b79/Google/firedept.png";
/// A UAV as TAK names it: friendly, airborne, military fixed or rotary unmanned.
const UAV_TYPE: &str = "a-f-A-M-F-Q";
/// What the schema has for "not known".
const UNKNOWN_M: f64 = 9_999_999.0;

/// Which type events get.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(in crate::ground) enum Profile {
    /// `a-u-G` with a fire icon: every client draws it.
    #[default]
    Marker,
    /// `a-u-X-i-f-h` and the like: an incident, a fire. Clients may draw a plain unknown.
    Semantic,
}

/// What an event says beside the incident.
#[derive(Debug, Clone, Copy)]
pub(super) struct Telling {
    pub profile: Profile,
    pub now: ServiceTime,
    /// After this long without a word, a client takes the marker away.
    pub stale: SignedDuration,
}

/// Name under which an incident stands on every TAK client.
pub(super) fn uid(id: &str) -> String {
    format!("emberfix.{id}")
}

/// The event that places or moves the marker.
pub(super) fn event(incident: &Incident, telling: &Telling) -> String {
    let how = if incident.aircraft().count() > 1 {
        "m-f"
    } else {
        "m-r"
    };
    envelope(
        &uid(&incident.id),
        kind(incident, telling.profile),
        how,
        telling,
    )
    .child(
        Element::new("point")
            .with("lat", format_args!("{:.7}", incident.place.latitude_deg()))
            .with("lon", format_args!("{:.7}", incident.place.longitude_deg()))
            .with("hae", format_args!("{:.1}", incident.place.height().m()))
            .with("ce", format_args!("{:.1}", incident.ce90_m))
            .with("le", format_args!("{:.1}", incident.le90_m)),
    )
    .child(detail(incident))
    .document()
}

/// The event that takes the marker away.
pub(super) fn deletion(id: &str, telling: &Telling) -> String {
    let link = Element::new("link")
        .with("uid", uid(id))
        .with("relation", "none")
        .with("type", "none");
    envelope(&uid(id), "t-x-d-d", "m-g", telling)
        .child(
            Element::new("point")
                .with("lat", 0)
                .with("lon", 0)
                .with("hae", UNKNOWN_M)
                .with("ce", UNKNOWN_M)
                .with("le", UNKNOWN_M),
        )
        .child(
            Element::new("detail")
                .child(link)
                .child(Element::new("__forcedelete")),
        )
        .document()
}

fn envelope(uid: &str, kind: &str, how: &str, telling: &Telling) -> Element {
    let now = to_the_millisecond(telling.now);
    Element::new("event")
        .with("version", "2.0")
        .with("uid", uid)
        .with("type", kind)
        .with("how", how)
        .with("time", &now)
        .with("start", &now)
        .with("stale", to_the_millisecond(telling.now + telling.stale))
}

fn kind(incident: &Incident, profile: Profile) -> &'static str {
    match (profile, incident.class) {
        (Profile::Marker, _) => "a-u-G",
        (Profile::Semantic, AlarmClass::Fire) => "a-u-X-i-f-h",
        (Profile::Semantic, AlarmClass::Smoke) => "a-u-X-i-f-s",
    }
}

fn detail(incident: &Incident) -> Element {
    let links = incident.aircraft().map(|uav| {
        Element::new("link")
            .with("uid", uav)
            .with("relation", "p-p")
            .with("type", UAV_TYPE)
    });
    Element::new("detail")
        .child(Element::new("contact").with("callsign", view::callsign(incident)))
        .child(Element::new("usericon").with("iconsetpath", ICON))
        .child(Element::new("color").with("argb", colour(incident)))
        .child(
            Element::new("precisionlocation")
                .with("geopointsrc", "CALC")
                .with("altsrc", "CALC"),
        )
        .children(links)
        .child(
            Element::leaf("remarks", view::lines(incident).join(". ")).with("source", "emberfix"),
        )
}

/// ARGB as the signed number that TAK wants: red burns, amber is not sure, grey is over.
fn colour(incident: &Incident) -> i32 {
    let argb: u32 = match (incident.state, incident.operator.state) {
        (FireState::Out, _) => 0xff80_8080,
        (FireState::Suspected, OperatorState::New | OperatorState::Acknowledged) => 0xffff_a000,
        _ => 0xffff_0000,
    };
    argb.cast_signed()
}

/// Clients parse three decimals, and some no more.
fn to_the_millisecond(at: ServiceTime) -> String {
    let text = at.rfc3339();
    format!("{}Z", text.get(..23).unwrap_or(&text))
}
