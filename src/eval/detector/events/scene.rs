//! What a flight looks at, and from where.

use emberfix_sim::dataset::{random_exposure, random_world};
use emberfix_sim::render::RenderConfig;
use emberfix_sim::state::BodyState;
use emberfix_sim::world::{
    FireConfig, LightConfig, LookalikeConfig, LookalikeKind, SmokeConfig, TerrainConfig, World,
    WorldConfig, WorldError,
};
use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};
use rand::Rng;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

/// Seconds of a flight, and looks a second.
pub const FLIGHT_S: f64 = 40.0;
/// Looks a second.
pub const LOOKS_HZ: f64 = 2.5;
/// Things stand this far from where the camera looks at most, as a share of the range: in the picture,
/// mostly.
const REACH: f64 = 0.22;
/// Flames' widths, pixels at the middle of the flight.
const FLAME_PX: (f64, f64) = (12.0, 48.0);
/// The rig's focal length, pixels.
const FOCAL_PX: f64 = 880.0;
/// The rig looks so far down by itself.
const DEPRESSION_RAD: f64 = 30.0 / 180.0 * PI;

/// One flight.
#[derive(Debug, Clone)]
pub struct Scene {
    /// What there is.
    pub world: World,
    /// How the camera exposes.
    pub exposure: RenderConfig,
    /// What looks like fire and is none.
    pub lookalikes: Vec<LookalikeConfig>,
    range_m: f64,
    depression_rad: f64,
    start_rad: f64,
    turn_rad_s: f64,
    closing_m_s: f64,
    sway: [(f64, f64); 2],
}

impl Scene {
    /// Half of the flights see fire; all see what looks like it.
    pub fn draw(rng: &mut ChaCha8Rng, flight: usize) -> Result<Self, WorldError> {
        let range_m = log_uniform(rng, 20.0, 70.0);
        let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
        let sway = [(); 2].map(|()| (rng.random_range(0.5..2.0), rng.random_range(0.0..TAU)));
        let config = config(rng, range_m, flight.is_multiple_of(2));
        Ok(Self {
            exposure: random_exposure(rng, &config.light),
            world: World::new(&config, rng.random())?,
            lookalikes: config.lookalikes,
            range_m,
            depression_rad: rng.random_range(20.0..55.0_f64).to_radians(),
            start_rad: rng.random_range(0.0..TAU),
            turn_rad_s: side * rng.random_range(0.01..0.12),
            closing_m_s: range_m / FLIGHT_S * rng.random_range(-0.3..0.3),
            sway,
        })
    }

    /// The lookalike that stands nearest to a place, and how far off, metres.
    pub fn nearest(&self, place_m: &Vector3<f64>) -> Option<(LookalikeKind, f64)> {
        let off =
            |thing: &LookalikeConfig| (thing.east_m - place_m.x).hypot(thing.north_m - place_m.y);
        let things = self.lookalikes.iter().map(|thing| (thing.kind, off(thing)));
        things.min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// Around the middle, nearer or further, looking there as steadily as gusts let it.
    pub fn body(&self, t_s: f64) -> BodyState {
        let angle = self.start_rad + self.turn_rad_s * t_s;
        let range_m = self.range_m - self.closing_m_s * (t_s - FLIGHT_S / 2.0);
        let (sin, cos) = self.depression_rad.sin_cos();
        let out = Vector2::new(angle.sin(), angle.cos());
        let ground_m = self.world.ground_up_m(0.0, 0.0);
        let flat = out * (range_m * cos);
        let position_m = Vector3::new(flat.x, flat.y, ground_m + range_m * sin);
        let around = Vector2::new(out.y, -out.x) * (range_m * cos * self.turn_rad_s);
        let inwards = -out * (self.closing_m_s * cos);
        let velocity = around + inwards;
        let gust =
            |(deg, phase): (f64, f64), hz: f64| deg.to_radians() * (TAU * hz * t_s + phase).sin();
        BodyState {
            t_s,
            position_m,
            enu_from_body: enu_from_body(
                angle + PI + gust(self.sway[0], 0.11),
                DEPRESSION_RAD - self.depression_rad + gust(self.sway[1], 0.17),
            ),
            velocity_m_s: Vector3::new(velocity.x, velocity.y, -self.closing_m_s * sin),
            rate_rad_s: Vector3::new(0.0, 0.0, self.turn_rad_s),
        }
    }
}

/// Heading clockwise from north, pitch nose up; level wings.
fn enu_from_body(heading_rad: f64, pitch_rad: f64) -> Matrix3<f64> {
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), heading_rad)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), pitch_rad);
    let enu_from_ned = Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
    enu_from_ned * turn.into_inner()
}

fn config(rng: &mut ChaCha8Rng, range_m: f64, burns: bool) -> WorldConfig {
    let fires = if burns { rng.random_range(1..=2) } else { 0 };
    let lookalikes = rng.random_range(1..=5);
    let mut config = random_world(rng);
    if let TerrainConfig::Hills { amplitude_m, .. } = &mut config.terrain {
        // Higher hills would hide what the flight is there to see.
        *amplitude_m = amplitude_m.min(2.0);
    }
    config.trees.spread_m = range_m;
    config.trees.count /= 3;
    config.trees.clearance_m = config.trees.clearance_m.max(2.0);
    WorldConfig {
        fires: (0..fires).map(|k| fire(rng, k, range_m)).collect(),
        smokes: smokes(rng, range_m, burns),
        lookalikes: (0..lookalikes).map(|_| lookalike(rng, range_m)).collect(),
        light: light(rng, &config.light),
        ..config
    }
}

fn fire(rng: &mut ChaCha8Rng, k: u32, range_m: f64) -> FireConfig {
    let place = place(rng, range_m);
    let width_m = log_uniform(rng, FLAME_PX.0, FLAME_PX.1) * range_m / FOCAL_PX;
    FireConfig {
        name: format!("fire {k}"),
        east_m: place.x,
        north_m: place.y,
        width_m,
        height_m: width_m * rng.random_range(0.8..1.8),
        smoke: rng.random_bool(0.5),
        ignites_at_s: -60.0,
        growth_m_s: width_m / FLIGHT_S * rng.random_range(-0.2..0.6),
    }
}

fn smokes(rng: &mut ChaCha8Rng, range_m: f64, burns: bool) -> Vec<SmokeConfig> {
    let smoulders = burns && rng.random_bool(0.2);
    let place = place(rng, range_m);
    let smoke = SmokeConfig {
        name: "smoulder".to_owned(),
        east_m: place.x,
        north_m: place.y,
        width_m: range_m * rng.random_range(0.02..0.08),
        height_m: range_m * rng.random_range(0.1..0.4),
        ignites_at_s: -600.0,
    };
    smoulders.then_some(smoke).into_iter().collect()
}

fn lookalike(rng: &mut ChaCha8Rng, range_m: f64) -> LookalikeConfig {
    const KINDS: [LookalikeKind; 6] = [
        LookalikeKind::RedRoof,
        LookalikeKind::SunGlint,
        LookalikeKind::OrangeVehicle,
        LookalikeKind::Lantern,
        LookalikeKind::Headlamps,
        LookalikeKind::Fog,
    ];
    let kind = KINDS.choose(rng).copied().unwrap_or(LookalikeKind::Lantern);
    let size_m = match kind {
        LookalikeKind::RedRoof => rng.random_range(4.0..12.0),
        LookalikeKind::SunGlint => rng.random_range(0.6..5.0),
        LookalikeKind::OrangeVehicle | LookalikeKind::Headlamps => rng.random_range(3.0..7.0),
        LookalikeKind::Lantern => rng.random_range(0.15..0.7),
        LookalikeKind::Fog => range_m * rng.random_range(0.1..0.4),
    };
    let place = place(rng, range_m);
    LookalikeConfig {
        kind,
        east_m: place.x,
        north_m: place.y,
        size_m,
    }
}

/// One evening in four the sun stands low and red.
fn light(rng: &mut ChaCha8Rng, light: &LightConfig) -> LightConfig {
    if !rng.random_bool(0.25) {
        return light.clone();
    }
    LightConfig {
        sun_elevation_deg: rng.random_range(3.0..10.0),
        sun: rng.random_range(0.4..1.0),
        ambience: rng.random_range(0.2..0.7),
        ..light.clone()
    }
}

fn place(rng: &mut ChaCha8Rng, range_m: f64) -> Vector2<f64> {
    let reach = REACH * range_m;
    Vector2::new(
        rng.random_range(-reach..reach),
        rng.random_range(-reach..reach),
    )
}

fn log_uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    rng.random_range(low.ln()..high.ln()).exp()
}
