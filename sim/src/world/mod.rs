//! What is there: terrain, fires, smoke, lookalikes.
//!
//! **Purpose.** A seeded world that any number of cameras can look at.
//! **In:** [`WorldConfig`] (the `[sim.world]` table) and a seed. **Out:** [`World`]: the ground's
//! height, where each fire truly stands, and the shapes that [`crate::render`] draws.
//!
//! **Frame.** East, north, up of the plane at the mission datum, metres; the plane is taken as flat
//! ground truth everywhere (at 1 km the Earth falls 8 cm beneath it). Time is seconds of flight.
//! **Assumptions.** A world with the same configuration and seed is the same world, to the bit.
//! **Known limits.** A flame's bed is as deep as it is wide (a disc of 0.3 widths radius), so from
//! above its lower edge in the image lies on the near rim, not on the middle of the bed.

mod burning;
mod config;
mod spread;
mod terrain;
mod texture;
mod things;

pub use config::{
    BoardConfig, FireConfig, GroundCover, LightConfig, LookalikeConfig, LookalikeKind, SmokeConfig,
    SpreadConfig, TerrainConfig, TreesConfig, WindConfig, WorldConfig,
};

pub use spread::Spread;

pub(crate) use burning::{Flame, Plume, Splat, SplatKind, unit};
pub(crate) use terrain::Terrain;
pub(crate) use texture::{Lod, Rgb, Texture, Textures, UNIT, hash, mix};
pub(crate) use things::{Ball, Mark, MarkKind, Quad, Things};
use things::{DARK, signal_orange};

use nalgebra::{Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What burns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BurningClass {
    /// A flame.
    Fire,
    /// Smoke.
    Smoke,
}

/// Where something truly burns.
#[derive(Debug, Clone, PartialEq)]
pub struct FireTruth {
    /// From the mission; unique in the world.
    pub name: String,
    /// Flame, or smoke alone.
    pub class: BurningClass,
    /// Where it stands: east, north, up, metres.
    pub base_m: Vector3<f64>,
    /// Widest part at ignition, metres.
    pub width_m: f64,
    /// Mean height at ignition, metres.
    pub height_m: f64,
    /// Seconds of flight.
    pub ignites_at_s: f64,
    /// Growth of the height, m/s; the width keeps its proportion.
    pub growth_m_s: f64,
    /// Whether a plume rises from a flame.
    pub smokes: bool,
    /// How it runs over the ground, if it does.
    pub spread: Option<Spread>,
}

impl FireTruth {
    /// Width and height in metres at a time; `None` before it ignites.
    #[must_use]
    pub fn size_at(&self, t_s: f64) -> Option<(f64, f64)> {
        let age = t_s - self.ignites_at_s;
        let factor = (1.0 + self.growth_m_s * age / self.height_m).max(0.02);
        (age >= 0.0).then_some((self.width_m * factor, self.height_m * factor))
    }
}

/// Why a world can't be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WorldError {
    /// A value that no world has; NaN always is one.
    #[error("sim.world.{key} is {value}, allowed is {low} to {high}")]
    OutOfRange {
        /// The key, with its place in the list.
        key: String,
        /// What the mission says.
        value: f64,
        /// Least allowed.
        low: f64,
        /// Greatest allowed.
        high: f64,
    },
    /// A spread of a fire that is not there.
    #[error("sim.world.spreads: no fire is named {name:?}")]
    NoSuchFire {
        /// The name.
        name: String,
    },
    /// Two fires or smokes of one name.
    #[error("sim.world: two fires are named {name:?}; names tell truth from truth")]
    DuplicateName {
        /// The name.
        name: String,
    },
    /// No cover.
    #[error("sim.world.ground is empty; it needs at least one cover, such as \"grass\"")]
    BareGround,
}

/// A world: configuration made solid.
#[derive(Debug, Clone)]
pub struct World {
    seed: u64,
    terrain: Terrain,
    textures: Textures,
    things: Things,
    fires: Vec<FireTruth>,
    light: LightConfig,
    wind_m_s: Vector2<f64>,
}

/// What shines or smokes at one moment, with the index of its fire.
pub(crate) struct Burning {
    pub fire: usize,
    pub class: BurningClass,
    pub splats: Vec<Splat>,
}

/// Moments that a reach is averaged over.
const REACH_TIMES: u32 = 9;
/// Share of a splat's half width at which its kernel `(1 - r²)²` is a half.
const HALF_DENSE: f64 = 0.541;

/// Light that a flame throws on the ground.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Glow {
    pub centre_m: Vector2<f64>,
    pub radius_m: f64,
    pub strength: f32,
}

impl World {
    /// Builds the world.
    ///
    /// # Errors
    /// [`WorldError`] that names the first value that no world has.
    pub fn new(config: &WorldConfig, seed: u64) -> Result<Self, WorldError> {
        check(config)?;
        let terrain = Terrain::new(&config.terrain, config.terrain_up_m);
        let mut world = Self {
            seed,
            textures: Textures::new(&config.ground, seed),
            things: Things::default(),
            fires: truths(config, &terrain),
            light: config.light.clone(),
            wind_m_s: Vector2::new(config.wind.east_m_s, config.wind.north_m_s),
            terrain,
        };
        world.place_lookalikes(&config.lookalikes);
        world.place_boards(&config.boards);
        world.place_trees(config);
        world.scorch();
        Ok(world)
    }

    /// Height of the ground above the datum's plane, metres.
    #[must_use]
    pub fn ground_up_m(&self, east_m: f64, north_m: f64) -> f64 {
        self.terrain.up_m(east_m, north_m)
    }

    /// Everything that burns or will burn: the fires of the mission, then its smokes.
    #[must_use]
    pub fn fires(&self) -> &[FireTruth] {
        &self.fires
    }

    /// How far the visible flame of a fire reaches from its base in a direction (unit vector; east,
    /// north, up) about a time, metres: the mean over two seconds before and after, as flames lick.
    /// Flame ends where a cloud is half as dense as in its middle. `None` for what is no flame then.
    #[must_use]
    pub fn flame_reach_m(&self, fire: usize, direction: &Vector3<f64>, t_s: f64) -> Option<f64> {
        let base_m = self.fires.get(fire)?.base_m;
        let mut sum = 0.0;
        for k in 0..REACH_TIMES {
            let off_s = 4.0 * (f64::from(k) / f64::from(REACH_TIMES - 1) - 0.5);
            let splats = self.flame_splats(fire, t_s + off_s)?;
            let reaches = splats.iter().map(|splat| {
                let half = splat.half_axis_m.dot(direction).hypot(splat.half_width_m);
                (splat.centre_m - base_m).dot(direction) + HALF_DENSE * half
            });
            sum += reaches.fold(f64::NEG_INFINITY, f64::max);
        }
        Some(sum / f64::from(REACH_TIMES))
    }

    /// Light of all flames from a place: face in m² times flicker over the squared range.
    #[must_use]
    pub fn flame_light(&self, from_m: &Vector3<f64>, t_s: f64) -> f64 {
        let light = |fire: usize| {
            let flame = self.flame(fire, t_s)?;
            let truth = &self.fires[fire];
            let age_s = t_s - truth.ignites_at_s;
            let sites = truth.spread.map_or(1, |spread| {
                spread.sites(flame.seed, flame.width_m, age_s).len()
            });
            let face_m2 = sites as f64 * flame.width_m * flame.height_m;
            let range2_m2 = (flame.base_m - from_m).norm_squared().max(1.0);
            Some(face_m2 * flame.flicker() * flame.temper() / range2_m2)
        };
        (0..self.fires.len()).filter_map(light).sum()
    }

    pub(crate) fn terrain(&self) -> &Terrain {
        &self.terrain
    }

    pub(crate) fn textures(&self) -> &Textures {
        &self.textures
    }

    pub(crate) fn things(&self) -> &Things {
        &self.things
    }

    pub(crate) fn light(&self) -> &LightConfig {
        &self.light
    }

    /// Towards the sun, unit length.
    pub(crate) fn sun(&self) -> Vector3<f64> {
        let (az, el) = (
            self.light.sun_azimuth_deg.to_radians(),
            self.light.sun_elevation_deg.to_radians(),
        );
        Vector3::new(az.sin() * el.cos(), az.cos() * el.cos(), el.sin())
    }

    /// Clouds of everything that burns at a time.
    pub(crate) fn burning(&self, t_s: f64) -> Vec<Burning> {
        let mut clouds = Vec::new();
        for (fire, truth) in self.fires.iter().enumerate() {
            if let Some(splats) = self.flame_splats(fire, t_s) {
                clouds.push(Burning {
                    fire,
                    class: BurningClass::Fire,
                    splats,
                });
            }
            if let Some(plume) = self.plume(fire, truth, t_s) {
                let splats = plume.splats();
                clouds.push(Burning {
                    fire,
                    class: BurningClass::Smoke,
                    splats,
                });
            }
        }
        clouds
    }

    /// Light of the flames on the ground at a time.
    pub(crate) fn glows(&self, t_s: f64) -> Vec<Glow> {
        let flames = (0..self.fires.len()).filter_map(|fire| self.flame(fire, t_s));
        flames
            .map(|flame| Glow {
                centre_m: flame.base_m.xy(),
                radius_m: 0.6 * flame.width_m + 0.4 * flame.height_m,
                strength: (0.16 * flame.flicker() * flame.temper()) as f32,
            })
            .collect()
    }

    fn flame(&self, fire: usize, t_s: f64) -> Option<Flame> {
        let truth = self
            .fires
            .get(fire)
            .filter(|truth| truth.class == BurningClass::Fire)?;
        let (width_m, height_m) = truth.size_at(t_s)?;
        let (seed, base_m, wind_m_s) = (self.fire_seed(fire), truth.base_m, self.wind_m_s);
        Some(Flame {
            seed,
            base_m,
            width_m,
            height_m,
            wind_m_s,
            t_s,
        })
    }

    /// One flame, or one at each place that a running fire burns at.
    fn flame_splats(&self, fire: usize, t_s: f64) -> Option<Vec<Splat>> {
        let flame = self.flame(fire, t_s)?;
        let truth = &self.fires[fire];
        let Some(spread) = truth.spread else {
            return Some(flame.splats());
        };
        let sites = spread.sites(flame.seed, flame.width_m, t_s - truth.ignites_at_s);
        let splats = sites.iter().enumerate().flat_map(|(k, site)| {
            let foot = flame.base_m.xy() + site;
            Flame {
                // A flame of the front goes with it, a site keeps its own while others come and go.
                seed: if k < Spread::FRONT {
                    hash(flame.seed, k as u32, 0xF07)
                } else {
                    let cell = [site.x, site.y].map(|metres| (metres * 64.0) as i32 as u32);
                    hash(flame.seed, cell[0], cell[1])
                },
                base_m: Vector3::new(foot.x, foot.y, self.ground_up_m(foot.x, foot.y)),
                ..flame
            }
            .splats()
        });
        Some(splats.collect())
    }

    fn plume(&self, fire: usize, truth: &FireTruth, t_s: f64) -> Option<Plume> {
        let (width_m, height_m) = truth.size_at(t_s)?;
        let from_flame = truth.class == BurningClass::Fire;
        if from_flame && !truth.smokes {
            return None;
        }
        let rises_m = if from_flame {
            4.0 * height_m + 3.0
        } else {
            height_m
        };
        let above_m = if from_flame { 0.75 * height_m } else { 0.0 };
        let seed = self.fire_seed(fire) ^ 0x5EED;
        Some(Plume {
            seed,
            foot_m: truth.base_m + Vector3::z() * above_m,
            width_m: if from_flame { 0.6 * width_m } else { width_m },
            height_m: rises_m,
            wind_m_s: self.wind_m_s,
            // A fire that burnt when the flight began has its plume already.
            age_s: if truth.ignites_at_s <= 0.0 {
                f64::INFINITY
            } else {
                t_s - truth.ignites_at_s
            },
            t_s,
            colour: self.smoke_colour(seed),
        })
    }

    /// From dark (oil) to near white (damp leaves), in today's light.
    fn smoke_colour(&self, seed: u64) -> [f32; 3] {
        let day = 0.35 + 0.35 * self.light.sun as f32 + 0.3 * self.light.ambience as f32;
        let grey = day * (0.16 + 0.44 * unit(seed, 0, 50) as f32);
        [0.99 * grey, grey, 1.04 * grey]
    }

    /// White, in today's light.
    fn fog_colour(&self) -> [f32; 3] {
        let day = 0.35 + 0.35 * self.light.sun as f32 + 0.3 * self.light.ambience as f32;
        [0.70, 0.71, 0.73].map(|c| c * day)
    }

    fn fire_seed(&self, fire: usize) -> u64 {
        hash(self.seed, fire as u32, 0xF1)
    }

    fn foot(&self, east_m: f64, north_m: f64) -> Vector3<f64> {
        Vector3::new(east_m, north_m, self.ground_up_m(east_m, north_m))
    }

    fn place_lookalikes(&mut self, lookalikes: &[LookalikeConfig]) {
        let sun = self.sun();
        for (k, thing) in lookalikes.iter().enumerate() {
            let foot = self.foot(thing.east_m, thing.north_m);
            let seed = hash(self.seed, k as u32, 0x10);
            match thing.kind {
                LookalikeKind::RedRoof => self.things.add_house(foot, thing.size_m, seed, &sun),
                LookalikeKind::SunGlint => self.things.add_puddle(foot, thing.size_m, seed),
                LookalikeKind::OrangeVehicle => {
                    let paint = signal_orange(seed);
                    self.things
                        .add_vehicle(foot, thing.size_m, seed, paint, &sun);
                }
                LookalikeKind::Lantern => self.things.add_lantern(foot, thing.size_m),
                LookalikeKind::Headlamps => {
                    self.things
                        .add_vehicle(foot, thing.size_m, seed, DARK, &sun);
                    self.things.add_headlamps(foot, thing.size_m, seed);
                }
                LookalikeKind::Fog => {
                    let colour = self.fog_colour();
                    self.things.add_fog(foot, thing.size_m, seed, colour);
                }
            }
        }
    }

    fn place_boards(&mut self, boards: &[BoardConfig]) {
        for board in boards {
            let foot = self.foot(board.east_m, board.north_m);
            self.things.add_board(foot, board);
        }
    }

    fn place_trees(&mut self, config: &WorldConfig) {
        let sun = self.sun();
        let mut rng = ChaCha8Rng::seed_from_u64(config.trees.seed ^ self.seed.rotate_left(17));
        let spread = config.trees.spread_m;
        let taken: Vec<Vector2<f64>> = places(config);
        for k in 0..config.trees.count {
            let at = Vector2::new(
                rng.random_range(-spread..=spread),
                rng.random_range(-spread..=spread),
            );
            let height_m = config.trees.height_m * rng.random_range(0.25..1.5);
            if taken
                .iter()
                .all(|place| (place - at).norm() > config.trees.clearance_m)
            {
                let seed = hash(self.seed, k, 0x7E);
                self.things
                    .add_tree(self.foot(at.x, at.y), height_m, seed, &sun);
            }
        }
    }

    /// What burns stands on burnt ground.
    fn scorch(&mut self) {
        for (fire, truth) in self.fires.iter().enumerate() {
            // Some stand on stone or in a tray: burnt ground must not be what gives a fire away.
            let burns_ground = unit(self.seed, fire as u32, 0x5D) < 0.6;
            if truth.class == BurningClass::Fire && burns_ground {
                let radius_m = truth.width_m * (0.4 + 0.8 * unit(self.seed, fire as u32, 0x5C));
                let centre_m = truth.base_m.xy();
                self.things.marks.push(Mark {
                    kind: MarkKind::Scorch,
                    centre_m,
                    radius_m,
                });
            }
        }
    }
}

fn places(config: &WorldConfig) -> Vec<Vector2<f64>> {
    let fires = config.fires.iter().map(|f| (f.east_m, f.north_m));
    let smokes = config.smokes.iter().map(|s| (s.east_m, s.north_m));
    let lookalikes = config.lookalikes.iter().map(|l| (l.east_m, l.north_m));
    let boards = config.boards.iter().map(|b| (b.east_m, b.north_m));
    fires
        .chain(smokes)
        .chain(lookalikes)
        .chain(boards)
        .map(|(east, north)| Vector2::new(east, north))
        .collect()
}

fn truths(config: &WorldConfig, terrain: &Terrain) -> Vec<FireTruth> {
    let base = |east: f64, north: f64| Vector3::new(east, north, terrain.up_m(east, north));
    let fires = config.fires.iter().map(|fire| FireTruth {
        name: fire.name.clone(),
        class: BurningClass::Fire,
        base_m: base(fire.east_m, fire.north_m),
        width_m: fire.width_m,
        height_m: fire.height_m,
        ignites_at_s: fire.ignites_at_s,
        growth_m_s: fire.growth_m_s,
        smokes: fire.smoke,
        spread: config
            .spreads
            .iter()
            .find(|spread| spread.fire == fire.name)
            .map(Spread::new),
    });
    let smokes = config.smokes.iter().map(|smoke| FireTruth {
        name: smoke.name.clone(),
        class: BurningClass::Smoke,
        base_m: base(smoke.east_m, smoke.north_m),
        width_m: smoke.width_m,
        height_m: smoke.height_m,
        ignites_at_s: smoke.ignites_at_s,
        growth_m_s: 0.0,
        smokes: true,
        spread: None,
    });
    fires.chain(smokes).collect()
}

fn check(config: &WorldConfig) -> Result<(), WorldError> {
    if config.ground.is_empty() {
        return Err(WorldError::BareGround);
    }
    range("terrain_up_m", config.terrain_up_m, -1000.0, 9000.0)?;
    if let TerrainConfig::Hills {
        amplitude_m,
        wavelength_m,
        ..
    } = config.terrain
    {
        range("terrain.amplitude_m", amplitude_m, 0.0, 300.0)?;
        // Steeper ground would hide itself from nearly every pose.
        range(
            "terrain.wavelength_m",
            wavelength_m,
            (8.0 * amplitude_m).max(5.0),
            1e5,
        )?;
    }
    check_fires(config)?;
    for (k, thing) in config.lookalikes.iter().enumerate() {
        let key = |name: &str| format!("lookalikes[{k}].{name}");
        check_place(&key, thing.east_m, thing.north_m)?;
        range(&key("size_m"), thing.size_m, 0.02, 100.0)?;
    }
    for (k, board) in config.boards.iter().enumerate() {
        let key = |name: &str| format!("boards[{k}].{name}");
        check_place(&key, board.east_m, board.north_m)?;
        range(&key("columns"), f64::from(board.columns), 2.0, 20.0)?;
        range(&key("rows"), f64::from(board.rows), 2.0, 20.0)?;
        range(&key("square_m"), board.square_m, 0.01, 5.0)?;
    }
    check_surroundings(config)
}

fn check_fires(config: &WorldConfig) -> Result<(), WorldError> {
    for (k, fire) in config.fires.iter().enumerate() {
        let key = |name: &str| format!("fires[{k}].{name}");
        check_place(&key, fire.east_m, fire.north_m)?;
        range(&key("width_m"), fire.width_m, 0.02, 100.0)?;
        range(&key("height_m"), fire.height_m, 0.02, 100.0)?;
        range(&key("growth_m_s"), fire.growth_m_s, -1.0, 1.0)?;
        range(&key("ignites_at_s"), fire.ignites_at_s, -1e6, 1e6)?;
    }
    for (k, spread) in config.spreads.iter().enumerate() {
        let key = |name: &str| format!("spreads[{k}].{name}");
        range(&key("azimuth_deg"), spread.azimuth_deg, -360.0, 360.0)?;
        range(&key("speed_m_s"), spread.speed_m_s, 0.001, 10.0)?;
        range(&key("flank"), spread.flank, 0.05, 1.0)?;
        range(&key("back"), spread.back, 0.01, 1.0)?;
        range(&key("residence_s"), spread.residence_s, 0.1, 1e6)?;
        if !config.fires.iter().any(|fire| fire.name == spread.fire) {
            let name = spread.fire.clone();
            return Err(WorldError::NoSuchFire { name });
        }
    }
    for (k, smoke) in config.smokes.iter().enumerate() {
        let key = |name: &str| format!("smokes[{k}].{name}");
        check_place(&key, smoke.east_m, smoke.north_m)?;
        range(&key("width_m"), smoke.width_m, 0.05, 100.0)?;
        range(&key("height_m"), smoke.height_m, 0.5, 500.0)?;
        range(&key("ignites_at_s"), smoke.ignites_at_s, -1e6, 1e6)?;
    }
    let names = config
        .fires
        .iter()
        .map(|f| &f.name)
        .chain(config.smokes.iter().map(|s| &s.name));
    let mut seen = std::collections::BTreeSet::new();
    match names.into_iter().find(|name| !seen.insert(*name)) {
        Some(name) => Err(WorldError::DuplicateName { name: name.clone() }),
        None => Ok(()),
    }
}

fn check_surroundings(config: &WorldConfig) -> Result<(), WorldError> {
    range("trees.count", f64::from(config.trees.count), 0.0, 5000.0)?;
    range("trees.height_m", config.trees.height_m, 0.1, 80.0)?;
    range("trees.spread_m", config.trees.spread_m, 1.0, 5000.0)?;
    range("trees.clearance_m", config.trees.clearance_m, 0.0, 5000.0)?;
    range(
        "light.sun_azimuth_deg",
        config.light.sun_azimuth_deg,
        -360.0,
        360.0,
    )?;
    range(
        "light.sun_elevation_deg",
        config.light.sun_elevation_deg,
        1.0,
        90.0,
    )?;
    range("light.sun", config.light.sun, 0.0, 3.0)?;
    range("light.ambience", config.light.ambience, 0.0, 3.0)?;
    range("light.visibility_m", config.light.visibility_m, 20.0, 1e6)?;
    range("wind.east_m_s", config.wind.east_m_s, -40.0, 40.0)?;
    range("wind.north_m_s", config.wind.north_m_s, -40.0, 40.0)
}

fn check_place(key: &dyn Fn(&str) -> String, east: f64, north: f64) -> Result<(), WorldError> {
    range(&key("east_m"), east, -1e5, 1e5)?;
    range(&key("north_m"), north, -1e5, 1e5)
}

fn range(key: &str, value: f64, low: f64, high: f64) -> Result<(), WorldError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(WorldError::OutOfRange {
        key: key.to_owned(),
        value,
        low,
        high,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fire(name: &str) -> FireConfig {
        FireConfig {
            name: name.to_owned(),
            east_m: 10.0,
            north_m: 20.0,
            width_m: 1.0,
            height_m: 1.5,
            smoke: true,
            ignites_at_s: 5.0,
            growth_m_s: 0.1,
        }
    }

    #[test]
    fn a_fire_stands_on_the_ground_and_grows_after_it_ignites() {
        let config = WorldConfig {
            terrain: TerrainConfig::Hills {
                amplitude_m: 6.0,
                wavelength_m: 150.0,
                seed: 2,
            },
            terrain_up_m: 12.0,
            fires: vec![fire("a")],
            ..WorldConfig::default()
        };
        let world = World::new(&config, 1).unwrap();
        let truth = &world.fires()[0];
        assert_eq!(truth.base_m.z, world.ground_up_m(10.0, 20.0));
        assert_eq!(truth.size_at(4.9), None);
        let (width, height) = truth.size_at(15.0).unwrap();
        assert!((height - 2.5).abs() < 1e-12 && (width - 2.5 / 1.5).abs() < 1e-12);
        assert!(world.burning(4.9).is_empty());
    }

    #[test]
    fn a_world_that_cannot_be_names_the_key() {
        let mut config = WorldConfig {
            fires: vec![fire("a")],
            ..WorldConfig::default()
        };
        config.fires[0].width_m = f64::NAN;
        let error = World::new(&config, 1).unwrap_err();
        assert!(
            error.to_string().contains("fires[0].width_m is NaN"),
            "{error}"
        );
        config.fires = vec![fire("a"), fire("a")];
        let error = World::new(&config, 1).unwrap_err();
        assert_eq!(
            error,
            WorldError::DuplicateName {
                name: "a".to_owned()
            }
        );
    }

    #[test]
    fn the_table_reads_from_toml_and_refuses_what_it_does_not_know() {
        let text = r#"
            terrain = { kind = "hills", amplitude_m = 6.0, wavelength_m = 180.0, seed = 4 }
            ground = ["grass", "soil"]
            [[fires]]
            name = "a"
            east_m = 1.0
            north_m = 2.0
            width_m = 1.0
            height_m = 1.0
            [[lookalikes]]
            kind = "red_roof"
            east_m = 30.0
            north_m = 2.0
            size_m = 8.0
        "#;
        let config: WorldConfig = toml::from_str(text).unwrap();
        assert_eq!(config.fires.len() + config.lookalikes.len(), 2);
        assert!(toml::from_str::<WorldConfig>("terrane = 1").is_err());
        assert!(
            toml::from_str::<WorldConfig>("terrain = { kind = \"flat\", hight_m = 1 }").is_err()
        );
    }
}
