//! One sighting as a GeoJSON Feature: the alarm's properties as far as one sighting has them.

use crate::alarm::Situation;
use crate::detect::BoxPx;
use crate::locate::{Fix, View};
use crate::track::Classified;
use emberfix_frames::{HeightAboveGround, Metres, Wgs84Parts};
use serde_json::{Value, json};

/// The Feature; its geometry is `null` when one look gives no position.
pub fn sighting(
    classified: &Classified,
    box_px: BoxPx,
    placed: Option<(&Fix, &Situation)>,
    view: &View<'_>,
) -> Value {
    let mut properties = json!({
        "class": classified.class,
        "confidence": classified.score,
        "captured_at": classified.sighting.at.rfc3339(),
        "box_px": [box_px.x, box_px.y, box_px.width, box_px.height],
        "glow": classified.sighting.glow,
        "disparity_px": classified.sighting.disparity.map(|disparity| disparity.px),
    });
    let Some((fix, situation)) = placed else {
        return json!({"type": "Feature", "geometry": null, "properties": properties});
    };
    let size = crate::assess::size(&classified.sighting, view, &fix.enu.metres());
    let place = fix.place;
    let more = json!({
        "altitude_msl_m": situation.altitude.m(),
        "height_above_ground_m": situation.above_ground.map(HeightAboveGround::m),
        "ce90_m": fix.covariance.ce90_m(),
        "le90_m": fix.covariance.le90_m(),
        "covariance_enu_m2": fix.covariance.row_major(),
        "methods": fix.methods,
        "range_m": fix.range_m,
        "size_m": size,
        "degraded": situation.degraded,
    });
    if let (Value::Object(properties), Value::Object(more)) = (&mut properties, more) {
        properties.extend(more);
    }
    json!({
        "type": "Feature",
        "geometry": {
            "type": "Point",
            "coordinates": [place.longitude_deg(), place.latitude_deg(), place.height().m()],
        },
        "properties": properties,
    })
}
