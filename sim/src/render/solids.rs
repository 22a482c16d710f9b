//! Trees, houses and cars: balls and flat parallelograms, hit by each pixel's own ray.

use super::camera::{EyePose, Lens};
use super::ground::{Band, Ground};
use super::{PixelBox, Reach};
use crate::world::{Ball, Quad, Things, UNIT};
use nalgebra::{Matrix3, Vector3};

/// Nothing nearer to the camera than this is drawn, metres.
const NEAREST_M: f64 = 0.4;
/// Nothing farther than this is drawn, metres.
const FARTHEST_M: f64 = 900.0;

/// A ball that an eye may see.
struct SeenBall {
    extent: PixelBox,
    centre: Vector3<f32>,
    /// Which leaves: no two balls wear the same.
    phase: f32,
    ball: Ball,
}

/// A parallelogram that an eye may see.
struct SeenQuad {
    extent: PixelBox,
    /// Takes a pixel's ray to (place along, place across, 1) times its reciprocal depth.
    from_ray: Matrix3<f32>,
    normal: Vector3<f32>,
    quad: Quad,
}

/// Everything opaque that stands in front of an eye.
pub(super) struct Solids {
    balls: Vec<SeenBall>,
    quads: Vec<SeenQuad>,
    focal_px: f32,
}

impl Solids {
    pub(super) fn new(things: &Things, pose: &EyePose, lens: &Lens) -> Self {
        Self {
            balls: things
                .balls
                .iter()
                .filter_map(|ball| see_ball(pose, lens, ball))
                .collect(),
            quads: things
                .quads
                .iter()
                .filter_map(|quad| see_quad(pose, lens, quad))
                .collect(),
            focal_px: lens.focal_px.0 as f32,
        }
    }

    /// Draws what reaches into a band, nearest in front.
    pub(super) fn draw(&self, band: &mut Band, ground: &Ground) {
        let rows = band.extent_rows();
        for seen in self.quads.iter().filter(|seen| seen.extent.reaches(&rows)) {
            self.draw_quad(band, ground, seen);
        }
        for seen in self.balls.iter().filter(|seen| seen.extent.reaches(&rows)) {
            self.draw_ball(band, ground, seen);
        }
    }

    fn draw_ball(&self, band: &mut Band, ground: &Ground, seen: &SeenBall) {
        let radius = seen.ball.radius_m as f32;
        let reach2 = seen.centre.norm_squared() - radius * radius;
        let footprint = seen.centre.z / self.focal_px;
        let leaves = ground.world().textures().leaves.lod(footprint);
        let enu_from_camera = ground.pose().enu_from_camera.cast::<f32>();
        seen.extent.each_pixel(band, |band, px, py, offset| {
            let (x, y) = ground.tangents_at(px, py);
            let ray = Vector3::new(x, y, 1.0);
            let (along, length2) = (ray.dot(&seen.centre), ray.norm_squared());
            let discriminant = along * along - length2 * reach2;
            if discriminant <= 0.0 {
                return;
            }
            let depth = (along - discriminant.sqrt()) / length2;
            if 1.0 / depth <= band.inv_depth[offset] {
                return;
            }
            let normal = enu_from_camera * ((ray * depth - seen.centre) / radius);
            let (across, up) = wrapped(&(normal * radius), &normal);
            let leaf = leaves.at(across + 7.0 * seen.phase, up)[1] * UNIT;
            // Ragged: towards the rim only the leaves that stick out are there.
            let rim = discriminant / (length2 * radius * radius);
            if rim < 0.45 && leaf < 1.25 - 1.2 * rim {
                return;
            }
            band.inv_depth[offset] = 1.0 / depth;
            band.colour[offset] = ground.lit(&normal, &seen.ball.albedo, leaf * leaf.min(1.3));
        });
    }

    fn draw_quad(&self, band: &mut Band, ground: &Ground, seen: &SeenQuad) {
        let quad = &seen.quad;
        let (long, wide) = (quad.along_m.norm() as f32, quad.across_m.norm() as f32);
        let grain = &ground.world().textures().middle;
        seen.extent.each_pixel(band, |band, px, py, offset| {
            let (x, y) = ground.tangents_at(px, py);
            let hit = seen.from_ray * Vector3::new(x, y, 1.0);
            let (along, across) = (hit.x / hit.z, hit.y / hit.z);
            let inside = (0.0..=1.0).contains(&along) && (0.0..=1.0).contains(&across);
            if !inside || hit.z <= band.inv_depth[offset] {
                return;
            }
            let footprint = 1.0 / (hit.z * self.focal_px);
            let patina = grain
                .lod(footprint)
                .at(2.0 * long * along, 2.0 * wide * across)[1]
                * UNIT;
            let gain = (0.6 + 0.4 * patina) * rows_gain(quad.rows, across, wide, footprint);
            band.inv_depth[offset] = hit.z;
            band.colour[offset] = ground.lit(&seen.normal, &quad.albedo, gain);
        });
    }

    /// Whether something opaque stands before a point of the picture at this depth.
    pub(super) fn hide(&self, (x, y): (f32, f32), depth: f32) -> bool {
        let ray = Vector3::new(x, y, 1.0);
        let ball_hides = |seen: &SeenBall| {
            let radius = seen.ball.radius_m as f32;
            let (along, length2) = (ray.dot(&seen.centre), ray.norm_squared());
            let discriminant =
                along * along - length2 * (seen.centre.norm_squared() - radius * radius);
            discriminant > 0.0 && (along - discriminant.sqrt()) / length2 < depth
        };
        let quad_hides = |seen: &SeenQuad| {
            let hit = seen.from_ray * ray;
            let (along, across) = (hit.x / hit.z, hit.y / hit.z);
            hit.z > 1.0 / depth && (0.0..=1.0).contains(&along) && (0.0..=1.0).contains(&across)
        };
        self.balls.iter().any(ball_hides) || self.quads.iter().any(quad_hides)
    }
}

/// Two coordinates of a place on a ball's skin, along the plane that it faces most.
fn wrapped(skin: &Vector3<f32>, normal: &Vector3<f32>) -> (f32, f32) {
    let [x, y, z] = [normal.x.abs(), normal.y.abs(), normal.z.abs()];
    if z > x && z > y {
        (skin.x, skin.y)
    } else if x > y {
        (skin.y + 1.1, skin.z)
    } else {
        (skin.x + 2.3, skin.z)
    }
}

/// Rows of tiles, lighter at the lower edge; they fade where they are finer than pixels.
fn rows_gain(rows: f32, across: f32, wide_m: f32, footprint_m: f32) -> f32 {
    if rows == 0.0 {
        return 1.0;
    }
    let row_px = wide_m / (rows * footprint_m);
    let depth = ((row_px - 1.5) / 4.0).clamp(0.0, 0.35);
    1.0 + depth * ((across * rows).fract() - 0.5)
}

fn see_ball(pose: &EyePose, lens: &Lens, ball: &Ball) -> Option<SeenBall> {
    let centre = pose.see(&ball.centre_m);
    if centre.z - ball.radius_m < NEAREST_M || centre.z > FARTHEST_M {
        return None;
    }
    let middle = lens.project(&centre)?;
    let tangent2 = (centre.x.powi(2) + centre.y.powi(2)) / centre.z.powi(2);
    // Off the axis a ball's image is stretched outwards.
    let reach =
        lens.focal_px.0 * ball.radius_m / (centre.z - ball.radius_m) * (1.0 + tangent2) + 2.0;
    let extent = PixelBox::around(middle, (reach, reach), lens)?;
    Some(SeenBall {
        extent,
        centre: centre.cast(),
        phase: ball.centre_m.x.fract() as f32,
        ball: *ball,
    })
}

fn see_quad(pose: &EyePose, lens: &Lens, quad: &Quad) -> Option<SeenQuad> {
    let corner = pose.see(&quad.corner_m);
    let along = pose.enu_from_camera.tr_mul(&quad.along_m);
    let across = pose.enu_from_camera.tr_mul(&quad.across_m);
    let mut extent: Option<Reach> = None;
    for place in [
        corner,
        corner + along,
        corner + across,
        corner + along + across,
    ] {
        if place.z < NEAREST_M || place.z > FARTHEST_M {
            return None;
        }
        let reach = PixelBox::unclipped(lens.project(&place)?, (3.0, 3.0));
        extent = Some(extent.map_or(reach, |so_far| so_far.with(&reach)));
    }
    let from_ray = Matrix3::from_columns(&[along, across, corner]).try_inverse()?;
    let normal = quad.along_m.cross(&quad.across_m).normalize();
    let facing = if normal.dot(&(quad.corner_m - pose.origin_m)) > 0.0 {
        -normal
    } else {
        normal
    };
    Some(SeenQuad {
        extent: extent?.clipped(lens)?,
        from_ray: from_ray.cast(),
        normal: facing.cast(),
        quad: *quad,
    })
}
