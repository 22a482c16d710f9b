//! Rendered fires that grow and run, seen from 10 to 100 m, through the code that flies.
//!
//! **Truth** is the simulator's: how far flame reaches in each direction, its height, the head's
//! speed and direction. **Boxes** are the renderer's at the pixel level, with errors such as a detector
//! has: a scale that stays for a flight (its box on its flames), and a jitter from look to look.
//! **Poses** are reported with errors that wander. **The tracker** is stood in for by the fire's
//! near edge with one range error per flight, drawn from the share that the assessment is told.
//! True width and height are how far the visible flames reach, to both sides of the line of sight
//! and upwards. Two fires in three run over the ground, the others grow or shrink where they are; three
//! flights in four circle the fire, the others stay on one side of it.

use crate::assess::extent::{Extent, Outline, Standing, Wind};
use crate::assess::outline::Look;
use crate::locate::{SharedPriors, Sighting, View};
use crate::pose::Pose;
use emberfix_calib::{Eye, RawPixel, RectifiedPixel, Rig};
use emberfix_frames::{
    Attitude, EllipsoidHeight, ServiceTime, Vector3, Wgs84, place_from_degrees, seconds,
};
use emberfix_frames::{Coordinate, Metres, MissionEnu, ecef_from_enu, place_from_ecef};
use emberfix_sim::noise::{GaussMarkov, normal, stream};
use emberfix_sim::render::{LabelBox, RenderConfig, Renderer, StereoCamera};
use emberfix_sim::state::BodyState;
use emberfix_sim::world::{
    BurningClass, FireConfig, FireTruth, SpreadConfig, WindConfig, World, WorldConfig,
};
use nalgebra::{Matrix3, Rotation3, Vector2};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Seconds of looking, and looks a second.
const FLIGHT_S: f64 = 40.0;
const LOOKS_HZ: f64 = 1.5;
/// One sigma of the range's share that is wrong for a whole flight.
const RANGE_SHARE: f64 = 0.05;
/// A detector's boxes against the flames: one sigma of the scale of a flight, and per look and edge
/// in pixels and as a share of the side.
const BOX_SCALE: f64 = 0.04;
const EDGE_PX: f64 = 1.0;
const EDGE_SHARE: f64 = 0.02;
/// Share of looks in which the detector finds nothing.
const MISSED: f64 = 0.15;
/// Errors of a consumer autopilot, one sigma.
const GNSS_M: (f64, f64) = (1.5, 2.5);
const GNSS_S: f64 = 90.0;
const HEADING_RAD: f64 = 0.02;
const TILT_RAD: f64 = 0.007;

/// Estimate and truth of one quantity.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Pair {
    /// What was told.
    pub told: f64,
    /// One sigma that was told.
    pub sigma: f64,
    /// What is true.
    pub truth: f64,
}

impl Pair {
    /// Error as a share of the truth.
    #[must_use]
    pub fn share(&self) -> f64 {
        (self.told - self.truth) / self.truth
    }

    /// Whether the 90 % interval holds the truth.
    #[must_use]
    pub fn holds90(&self) -> bool {
        (self.told - self.truth).abs() <= 1.644_854 * self.sigma
    }
}

/// What one flight came to.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Outcome {
    /// Seed of the flight.
    pub seed: u64,
    /// Metres from the camera to the fire's ignition at the end.
    pub range_m: f64,
    /// Metres.
    pub width: Pair,
    /// Metres.
    pub height: Pair,
    /// Whether it runs.
    pub runs: bool,
    /// Degrees of a circle about it from which it was seen.
    pub view_deg: f64,
    /// m/s and degrees, where a running fire was told as one.
    pub speed: Option<Pair>,
    /// Degrees; the truth is written within half a turn of what was told.
    pub azimuth: Option<Pair>,
    /// A spread was told of a fire that does not run.
    pub false_spread: bool,
}

/// Why a flight can't be simulated.
#[derive(Debug, thiserror::Error)]
pub enum FlightError {
    /// The world was refused.
    #[error(transparent)]
    World(#[from] emberfix_sim::world::WorldError),
    /// The datum is nowhere.
    #[error(transparent)]
    Datum(#[from] emberfix_frames::PlaceError),
}

/// One flight drawn from a seed.
struct Scene {
    range_m: f64,
    depression_rad: f64,
    start_rad: f64,
    turn_rad_s: f64,
    world: World,
    wind: Option<Wind>,
}

/// One flight; `None` when the fire left the picture, and there was nothing to assess.
///
/// # Errors
/// [`FlightError`].
pub fn fly(rig: &Rig, seed: u64, flight: usize) -> Result<Option<Outcome>, FlightError> {
    let mut rng = stream(seed, &format!("growing fire {flight}"));
    let scene = Scene::draw(&mut rng, flight)?;
    let datum = place_from_degrees(31.409_422_2, 119.112_016_7, EllipsoidHeight::from_m(8.7067))?;
    let truth = scene.world.fires()[0].clone();
    let renderer = Renderer::new(
        Arc::new(scene.world.clone()),
        StereoCamera::new(rig),
        RenderConfig::default(),
    );
    let mut watch = Watch::new(rig, &scene, datum, &mut rng);
    for k in 0..=(FLIGHT_S * LOOKS_HZ) as usize {
        let t_s = k as f64 / LOOKS_HZ;
        if rng.random_bool(MISSED) {
            continue;
        }
        let body = scene.body(t_s);
        let labels = renderer.label_boxes(&body, t_s);
        let label = labels
            .iter()
            .find(|label| label.class == BurningClass::Fire);
        if let Some(label) = label {
            watch.look(label, &body, t_s, &mut rng);
        }
    }
    let outcome = watch.outcome(&scene, &truth);
    Ok(outcome.map(|outcome| Outcome { seed, ..outcome }))
}

impl Scene {
    fn draw(rng: &mut ChaCha8Rng, flight: usize) -> Result<Self, FlightError> {
        let mut draw = |low: f64, high: f64| rng.random_range(low..high);
        let range_m = 10.0 * 10_f64.powf(draw(0.0, 1.0));
        let width_m = (range_m * draw(0.02, 0.06)).max(0.3);
        let height_m = width_m * draw(0.8, 1.6);
        let runs = !flight.is_multiple_of(3);
        let azimuth_deg = draw(0.0, 360.0);
        let speed_m_s = range_m / FLIGHT_S * draw(0.08, 0.3);
        let wind_m_s = draw(0.5, 5.0);
        // The head runs before the wind, more or less.
        let off = draw(-0.5, 0.5);
        let blows = Vector2::new(
            (azimuth_deg.to_radians() + off).sin(),
            (azimuth_deg.to_radians() + off).cos(),
        ) * wind_m_s;
        let config = WorldConfig {
            fires: vec![FireConfig {
                name: "fire".to_owned(),
                east_m: 0.0,
                north_m: 0.0,
                width_m,
                height_m,
                smoke: false,
                ignites_at_s: -draw(2.0, 15.0),
                growth_m_s: if runs {
                    0.0
                } else {
                    height_m / FLIGHT_S * draw(-0.4, 1.5)
                },
            }],
            spreads: runs
                .then(|| SpreadConfig {
                    fire: "fire".to_owned(),
                    azimuth_deg,
                    speed_m_s,
                    flank: draw(0.3, 0.5),
                    back: draw(0.05, 0.2),
                    residence_s: draw(20.0, 60.0),
                })
                .into_iter()
                .collect(),
            wind: WindConfig {
                east_m_s: blows.x,
                north_m_s: blows.y,
            },
            ..WorldConfig::default()
        };
        let side = if draw(0.0, 1.0) < 0.5 { 1.0 } else { -1.0 };
        let turn = side
            * if flight.is_multiple_of(4) {
                draw(0.0, 0.01)
            } else {
                draw(0.03, 0.12)
            };
        let (depression, start) = (draw(20.0, 45.0), draw(0.0, 360.0));
        let knows_wind = draw(0.0, 1.0) < 0.5;
        let wind_error = Vector2::new(draw(-1.0, 1.0), draw(-1.0, 1.0));
        Ok(Self {
            range_m,
            depression_rad: depression.to_radians(),
            start_rad: start.to_radians(),
            turn_rad_s: turn,
            world: World::new(&config, rng.random())?,
            wind: knows_wind.then_some(Wind {
                towards_m_s: blows + wind_error,
                sigma_m_s: 0.7,
            }),
        })
    }

    /// How far flame reaches over the ground, metres.
    fn reach_m(&self, outwards: &Vector2<f64>, t_s: f64) -> Option<f64> {
        let outwards = Vector3::new(outwards.x, outwards.y, 0.0);
        self.world.flame_reach_m(0, &outwards, t_s)
    }

    /// On a circle about the fire, looking a little ahead of where the head may be.
    fn body(&self, t_s: f64) -> BodyState {
        let angle = self.start_rad + self.turn_rad_s * t_s;
        let (sin, cos) = self.depression_rad.sin_cos();
        let out = Vector2::new(angle.sin(), angle.cos());
        let position_m = Vector3::new(
            out.x * self.range_m * cos,
            out.y * self.range_m * cos,
            self.range_m * sin,
        );
        let around = Vector2::new(out.y, -out.x) * (self.range_m * cos * self.turn_rad_s);
        BodyState {
            t_s,
            position_m,
            enu_from_body: enu_from_body(angle + std::f64::consts::PI, self.pitch_rad()),
            velocity_m_s: Vector3::new(around.x, around.y, 0.0),
            rate_rad_s: Vector3::new(0.0, 0.0, self.turn_rad_s),
        }
    }

    /// The rig looks 30 degrees down by itself.
    fn pitch_rad(&self) -> f64 {
        30_f64.to_radians() - self.depression_rad
    }
}

/// Heading clockwise from north, pitch nose up; level wings.
fn enu_from_body(heading_rad: f64, pitch_rad: f64) -> Matrix3<f64> {
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), heading_rad)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), pitch_rad);
    let enu_from_ned = Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
    enu_from_ned * turn.into_inner()
}

/// What the aircraft makes of a flight.
struct Watch<'a> {
    rig: &'a Rig,
    datum: Wgs84,
    pitch_rad: f64,
    outline: Outline,
    gnss: [GaussMarkov; 3],
    heading_off_rad: f64,
    pitch_off_rad: f64,
    box_scale: (f64, f64),
    range_off: f64,
    last_t_s: f64,
}

impl<'a> Watch<'a> {
    fn new(rig: &'a Rig, scene: &Scene, datum: Wgs84, rng: &mut ChaCha8Rng) -> Self {
        let mut gnss = |sigma| GaussMarkov::new(rng, sigma, GNSS_S, FLIGHT_S);
        let gnss = [gnss(GNSS_M.0), gnss(GNSS_M.0), gnss(GNSS_M.1)];
        let mut scale = || 1.0 + BOX_SCALE * normal(rng);
        Self {
            rig,
            datum,
            pitch_rad: scene.pitch_rad(),
            outline: Outline::default(),
            gnss,
            box_scale: (scale(), scale()),
            heading_off_rad: HEADING_RAD * normal(rng),
            pitch_off_rad: TILT_RAD * normal(rng),
            range_off: RANGE_SHARE * normal(rng),
            last_t_s: 0.0,
        }
    }

    fn look(&mut self, label: &LabelBox, body: &BodyState, t_s: f64, rng: &mut ChaCha8Rng) {
        let Some(sighting) = self.sighting(label, t_s, rng) else {
            return;
        };
        let Some(pose) = self.pose(body, t_s) else {
            return;
        };
        let sigmas = SharedPriors {
            heading_rad: HEADING_RAD,
            tilt_rad: TILT_RAD,
            ..SharedPriors::default()
        };
        let view = View::new(self.rig, &pose, &sigmas, &self.datum);
        self.outline.add(Look::of(&sighting, &view));
        self.last_t_s = t_s;
    }

    /// The label as a detector would box it, where the picture holds all of it.
    fn sighting(&self, label: &LabelBox, t_s: f64, rng: &mut ChaCha8Rng) -> Option<Sighting> {
        let (columns, rows) = self.rig.camera(Eye::Left).image_size_px;
        let inside = label.left_px > 2.0
            && label.top_px > 2.0
            && label.right_px < f64::from(columns) - 3.0
            && label.bottom_px < f64::from(rows) - 3.0;
        if !inside {
            return None;
        }
        let (width, height) = (
            label.right_px - label.left_px,
            label.bottom_px - label.top_px,
        );
        let mut edge = |at: f64, side: f64| at + EDGE_PX.max(EDGE_SHARE * side) * normal(rng);
        let grown = (
            (self.box_scale.0 - 1.0) * width / 2.0,
            (self.box_scale.1 - 1.0) * height,
        );
        let left = edge(label.left_px - grown.0, width);
        let right = edge(label.right_px + grown.0, width);
        let top = edge(label.top_px - grown.1, height);
        let bottom = edge(label.bottom_px, height);
        let rectification = self.rig.rectification();
        let raw = RawPixel {
            u: (left + right) / 2.0,
            v: bottom,
        };
        let base: RectifiedPixel = *rectification.rectify(Eye::Left, &[raw]).ok()?.first()?;
        let scale = rectification.focal_px() / self.rig.camera(Eye::Left).focal_px.0;
        Some(Sighting {
            at: ServiceTime::from_unix_ns(0) + seconds(t_s),
            base,
            base_sigma_px: (2.0, 2.0),
            size_px: ((right - left) * scale, (bottom - top) * scale),
            disparity: None,
            glow: None,
            at_least_m: None,
        })
    }

    fn gnss_off(&self, t_s: f64) -> Vector3<f64> {
        let [east, north, up] = &self.gnss;
        Vector3::new(east.at(t_s), north.at(t_s), up.at(t_s))
    }

    fn pose(&self, body: &BodyState, t_s: f64) -> Option<Pose> {
        let reported = body.position_m + self.gnss_off(t_s);
        let heading = body.enu_from_body[(0, 0)].atan2(body.enu_from_body[(1, 0)]);
        let ecef =
            ecef_from_enu::<MissionEnu>(&self.datum).transform(Coordinate::from_metres(reported));
        Some(Pose {
            at: ServiceTime::from_unix_ns(0) + seconds(t_s),
            place: place_from_ecef(&ecef)?,
            attitude: Attitude::from_angles(
                0.0,
                self.pitch_rad + self.pitch_off_rad,
                heading + self.heading_off_rad,
            ),
            velocity_enu_m_s: body.velocity_m_s,
            rate_rad_s: body.rate_rad_s,
            gnss_horizontal_m: GNSS_M.0,
            gnss_vertical_m: GNSS_M.1,
            attitude_noise_rad: 0.002,
            position_noise_m: 0.03,
            time_sigma_s: 0.002,
            degraded: BTreeSet::new(),
        })
    }

    /// Where the tracker would have the near edge, in the reported plane, and how surely.
    fn standing(&self, scene: &Scene) -> Option<Standing> {
        let t_s = self.last_t_s;
        let camera = scene.body(t_s).position_m;
        let towards = camera.xy() / camera.xy().norm();
        let near = towards * scene.reach_m(&towards, t_s)?;
        let near = Vector3::new(near.x, near.y, 0.0);
        let placed = camera + (near - camera) * (1.0 + self.range_off);
        Some(Standing {
            foot: placed + self.gnss_off(t_s),
            range_share: RANGE_SHARE,
            wander_m: (
                GNSS_M.0 * (2.0 / GNSS_S).sqrt(),
                GNSS_M.1 * (2.0 / GNSS_S).sqrt(),
            ),
            turn_rad: (HEADING_RAD, TILT_RAD),
        })
    }

    fn outcome(&self, scene: &Scene, truth: &FireTruth) -> Option<Outcome> {
        let standing = self.standing(scene)?;
        let extent = self.outline.extent(&standing, scene.wind.as_ref())?;
        let t_s = self.last_t_s;
        let camera = scene.body(t_s).position_m;
        let side = Vector2::new(camera.y, -camera.x).normalize();
        let width = scene.reach_m(&side, t_s)? + scene.reach_m(&-side, t_s)?;
        let height = scene.world.flame_reach_m(0, &Vector3::z(), t_s)?;
        Some(Outcome::of(&extent, truth, width, height, scene))
    }
}

impl Outcome {
    fn of(extent: &Extent, truth: &FireTruth, width: f64, height: f64, scene: &Scene) -> Self {
        let pair = |told: crate::assess::extent::Measured, truth: f64| Pair {
            told: told.value,
            sigma: told.sigma,
            truth,
        };
        let told = extent.spread.zip(truth.spread);
        let azimuth = told.map(|(told, truth)| {
            let is = truth.towards.x.atan2(truth.towards.y).to_degrees();
            let off = (is - told.azimuth_deg.value + 540.0).rem_euclid(360.0) - 180.0;
            pair(told.azimuth_deg, told.azimuth_deg.value + off)
        });
        Self {
            seed: 0,
            range_m: scene.range_m,
            width: pair(extent.width_m, width),
            height: pair(extent.height_m, height),
            runs: truth.spread.is_some(),
            view_deg: (scene.turn_rad_s.abs() * FLIGHT_S).to_degrees(),
            speed: told.map(|(told, truth)| pair(told.speed_m_s, truth.speed_m_s)),
            azimuth,
            false_spread: truth.spread.is_none() && extent.spread.is_some(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flight_repeats_and_tells_a_width() {
        let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/calib/rigs/oakd-75mm.toml");
        let rig = Rig::load(rig.as_ref()).unwrap();
        let one = fly(&rig, 5, 3).unwrap().unwrap();
        assert_eq!(Some(one), fly(&rig, 5, 3).unwrap());
        assert!(one.width.share().abs() < 0.5, "{one:?}");
    }
}
