//! KML 2.2: for Google Earth, ATAK, QGIS.
//!
//! `GET /emberfix.kml` is a link that asks for `GET /incidents.kml` every [`REFRESH_S`]. Points
//! stand at their altitude above mean sea level (KML's `absolute`); ellipses and burning ground lie
//! on the ground.

use super::view::{self, second};
use super::xml::Element;
use crate::alarm::{AlarmClass, FireState};
use crate::ground::Ping;
use crate::ground::incident::Incident;
use emberfix_frames::{ServiceTime, Wgs84Parts};
use std::sync::Arc;

const NAMESPACE: &str = "http://www.opengis.net/kml/2.2";
/// How often a viewer asks again, seconds.
const REFRESH_S: u32 = 5;
/// Corners of an ellipse.
const CORNERS: u32 = 48;
/// KML colours are alpha, blue, green, red.
const STYLES: [(&str, &str, &str); 4] = [
    ("fire", "ff0e26b3", "400e26b3"),
    ("smoke", "ff9a4f4a", "409a4f4a"),
    ("out", "ff757069", "30757069"),
    ("uav", "ff976f2a", "00976f2a"),
];

/// The document that a viewer opens once; `base` is where this station is reached.
pub(super) fn network_link(base: &str) -> String {
    let link = Element::new("Link")
        .field("href", format_args!("{base}/incidents.kml"))
        .field("refreshMode", "onInterval")
        .field("refreshInterval", REFRESH_S);
    let network_link = Element::new("NetworkLink")
        .field("name", "Fires")
        .field("open", 1)
        .child(link);
    kml(Element::new("Document")
        .field("name", "emberfix")
        .child(network_link))
}

/// Everything as it stands.
pub(super) fn document(
    incidents: &[Arc<Incident>],
    aircraft: &[Ping],
    base: &str,
    now: ServiceTime,
) -> String {
    let shown = incidents.iter().filter(|incident| view::is_shown(incident));
    let fires = Element::new("Folder")
        .field("name", "Fires")
        .field("open", 1)
        .children(shown.map(|incident| placemark(incident)));
    let craft = Element::new("Folder")
        .field("name", "Aircraft")
        .children(aircraft.iter().map(craft));
    kml(Element::new("Document")
        .field("name", format_args!("Fires at {}", second(now)))
        .children(STYLES.iter().map(|style| self::style(style, base)))
        .child(fires)
        .child(craft))
}

fn kml(document: Element) -> String {
    Element::new("kml")
        .with("xmlns", NAMESPACE)
        .child(document)
        .document()
}

fn style((name, line, fill): &(&str, &str, &str), base: &str) -> Element {
    let icon = Element::new("Icon").field("href", format_args!("{base}/icons/{name}.png"));
    Element::new("Style")
        .with("id", name)
        .child(Element::new("IconStyle").field("scale", "1.1").child(icon))
        .child(Element::new("LabelStyle").field("scale", "0.9"))
        .child(
            Element::new("LineStyle")
                .field("color", line)
                .field("width", 2),
        )
        .child(Element::new("PolyStyle").field("color", fill))
}

fn style_of(incident: &Incident) -> &'static str {
    match (incident.state, incident.class) {
        (FireState::Out, _) => "#out",
        (_, AlarmClass::Fire) => "#fire",
        (_, AlarmClass::Smoke) => "#smoke",
    }
}

/// Point and ellipse in one placemark: one balloon, one entry in the viewer's list.
fn placemark(incident: &Incident) -> Element {
    let [longitude, latitude, _] = incident.coordinates();
    let coordinates = format!(
        "{longitude:.8},{latitude:.8},{:.2}",
        incident.altitude_msl_m
    );
    let point = Element::new("Point")
        .field("altitudeMode", "absolute")
        .field("coordinates", coordinates);
    let rings = view::ellipse90(incident, CORNERS);
    let shapes = Element::new("MultiGeometry")
        .child(point)
        .children(rings.iter().map(|ring| polygon(ring)));
    Element::new("Placemark")
        .with("id", super::cap::token(&incident.id))
        .field("name", view::callsign(incident))
        .field("description", balloon(incident))
        .child(Element::new("TimeStamp").field("when", second(incident.captured_at)))
        .field("styleUrl", style_of(incident))
        .child(data(incident))
        .child(shapes)
}

/// Text of the balloon: HTML, whose own markup is escaped once for HTML and once more for XML.
fn balloon(incident: &Incident) -> String {
    let line = |line: &String| Element::leaf("p", line).to_string();
    view::lines(incident).iter().map(line).collect()
}

fn data(incident: &Incident) -> Element {
    let values = [
        ("incident", incident.id.clone()),
        ("confidence", format!("{:.2}", incident.confidence)),
        ("ce90_m", format!("{:.1}", incident.ce90_m)),
        ("le90_m", format!("{:.1}", incident.le90_m)),
        (
            "height_ellipsoid_m",
            format!("{:.1}", incident.place.height().m()),
        ),
        ("captured_at", incident.captured_at.rfc3339()),
    ];
    let value = |(name, value): (&'static str, String)| {
        Element::new("Data")
            .with("name", name)
            .field("value", value)
    };
    Element::new("ExtendedData").children(values.into_iter().map(value))
}

fn polygon(ring: &[[f64; 2]]) -> Element {
    let coordinates: Vec<String> = ring
        .iter()
        .map(|[lon, lat]| format!("{lon:.8},{lat:.8}"))
        .collect();
    let ring = Element::new("LinearRing").field("coordinates", coordinates.join(" "));
    Element::new("Polygon")
        .field("tessellate", 1)
        .child(Element::new("outerBoundaryIs").child(ring))
}

fn craft(ping: &Ping) -> Element {
    // On the ground below it: a height above the ellipsoid is none that KML knows.
    let coordinates = format!("{:.7},{:.7}", ping.longitude_deg, ping.latitude_deg);
    Element::new("Placemark")
        .field("name", &ping.uav)
        .field(
            "description",
            format_args!("{}, last heard {}", ping.health, second(ping.at)),
        )
        .field("styleUrl", "#uav")
        .child(Element::new("Point").field("coordinates", coordinates))
}
