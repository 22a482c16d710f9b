//! What the terrain lets a picture expect: how far away, and how large, the ground behind each pixel is.

use crate::detect::GroundScale;
use crate::locate::{Terrain, TerrainHit, View, meet_terrain};
use emberfix_calib::{Eye, RawPixel, RectifiedPixel};

/// Disparity of the ground behind a pixel of the rectified left image, pixels.
pub(super) fn disparity_px(
    pixel: RectifiedPixel,
    view: &View<'_>,
    terrain: Option<&dyn Terrain>,
) -> Option<f64> {
    let depth_m = depth_m(pixel, view, terrain?)?;
    Some(view.rig.disparity_px(depth_m))
}

/// Depth along the boresight of the ground behind a pixel of the rectified left image, metres.
fn depth_m(pixel: RectifiedPixel, view: &View<'_>, terrain: &dyn Terrain) -> Option<f64> {
    let ray = view.ray_enu(pixel);
    match meet_terrain(&view.camera_enu, &ray, terrain, view) {
        TerrainHit::Met { range_m, .. } => {
            let depth_m = view.enu_from_cam.column(2).dot(&ray) * range_m;
            (depth_m > 0.0).then_some(depth_m)
        }
        _ => None,
    }
}

/// How large things on the ground appear over the raw left image.
pub(super) fn scale(view: &View<'_>, terrain: Option<&dyn Terrain>) -> Option<GroundScale> {
    let terrain = terrain?;
    let camera = view.rig.camera(Eye::Left);
    let rectification = view.rig.rectification();
    Some(GroundScale::sampled(camera.image_size_px, |u, v| {
        let raw = [RawPixel { u, v }];
        let pixel = *rectification.rectify(Eye::Left, &raw).ok()?.first()?;
        Some(camera.focal_px.0 / depth_m(pixel, view, terrain)?)
    }))
}
