//! What a mission says of the world: the `[sim.world]` table.

use serde::{Deserialize, Serialize};

/// The `[sim.world]` table of a mission; lengths in metres, east and north from the mission datum.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldConfig {
    /// Shape of the ground.
    pub terrain: TerrainConfig,
    /// Base level of the ground above the mission datum's plane.
    pub terrain_up_m: f64,
    /// What covers the ground, in patches; at least one.
    pub ground: Vec<GroundCover>,
    /// Flames.
    pub fires: Vec<FireConfig>,
    /// Fires that run over the ground.
    pub spreads: Vec<SpreadConfig>,
    /// Smoke without a visible flame.
    pub smokes: Vec<SmokeConfig>,
    /// Things that a detector takes for fire.
    pub lookalikes: Vec<LookalikeConfig>,
    /// Chessboards that lie on the ground, to calibrate by.
    pub boards: Vec<BoardConfig>,
    /// Trees and bushes.
    pub trees: TreesConfig,
    /// Sun and sky.
    pub light: LightConfig,
    /// What moves the smoke and leans the flames.
    pub wind: WindConfig,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self {
            terrain: TerrainConfig::Flat {},
            terrain_up_m: 0.0,
            ground: vec![GroundCover::Grass, GroundCover::Soil],
            fires: Vec::new(),
            spreads: Vec::new(),
            smokes: Vec::new(),
            lookalikes: Vec::new(),
            boards: Vec::new(),
            trees: TreesConfig::default(),
            light: LightConfig::default(),
            wind: WindConfig::default(),
        }
    }
}

/// Shape of the ground.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum TerrainConfig {
    /// A plane.
    Flat {},
    /// Rolling hills about the base level.
    Hills {
        /// Greatest height above (and depth below) the base level.
        amplitude_m: f64,
        /// Crest to crest of the longest wave.
        wavelength_m: f64,
        /// Which hills.
        seed: u64,
    },
}

/// What covers the ground.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GroundCover {
    /// Green.
    Grass,
    /// Yellow and dry.
    Straw,
    /// Brown.
    Soil,
    /// Red-brown.
    RedSoil,
    /// Grey.
    Rock,
    /// Dark green and brown.
    ForestFloor,
    /// Dark grey.
    Asphalt,
    /// Near white.
    Snow,
}

/// A flame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FireConfig {
    /// Unique in the world.
    pub name: String,
    /// Where it stands.
    pub east_m: f64,
    /// Where it stands.
    pub north_m: f64,
    /// Widest part of the flame when it ignites.
    pub width_m: f64,
    /// Mean height of the flame when it ignites.
    pub height_m: f64,
    /// Whether a plume rises from it.
    #[serde(default)]
    pub smoke: bool,
    /// Seconds of flight.
    #[serde(default)]
    pub ignites_at_s: f64,
    /// How fast the height grows; the width keeps its proportion.
    #[serde(default)]
    pub growth_m_s: f64,
}

/// How a flame of `fires` runs over the ground; without it, a flame stays where it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpreadConfig {
    /// Name of the fire.
    pub fire: String,
    /// Where its head runs to, clockwise from north.
    pub azimuth_deg: f64,
    /// Speed of the head.
    pub speed_m_s: f64,
    /// Speed of the flanks, as a share of the head's.
    #[serde(default = "usual_flank")]
    pub flank: f64,
    /// Speed of the back, as a share of the head's.
    #[serde(default = "usual_back")]
    pub back: f64,
    /// How long a place burns.
    #[serde(default = "usual_residence_s")]
    pub residence_s: f64,
}

fn usual_flank() -> f64 {
    0.4
}

fn usual_back() -> f64 {
    0.1
}

fn usual_residence_s() -> f64 {
    30.0
}

/// Smoke without a visible flame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SmokeConfig {
    /// Unique in the world.
    pub name: String,
    /// Where it rises from the ground.
    pub east_m: f64,
    /// Where it rises from the ground.
    pub north_m: f64,
    /// Width of the plume at its foot.
    pub width_m: f64,
    /// Height at which it has thinned out.
    pub height_m: f64,
    /// Seconds of flight.
    #[serde(default)]
    pub ignites_at_s: f64,
}

/// A thing that a detector takes for fire.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LookalikeConfig {
    /// What it is.
    pub kind: LookalikeKind,
    /// Where it stands.
    pub east_m: f64,
    /// Where it stands.
    pub north_m: f64,
    /// Its longest side.
    pub size_m: f64,
}

/// Things that a detector takes for fire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LookalikeKind {
    /// A house with a red-orange roof.
    RedRoof,
    /// The sun in a puddle.
    SunGlint,
    /// A car.
    OrangeVehicle,
    /// A steady orange lamp.
    Lantern,
    /// A dark car with its headlamps on.
    Headlamps,
    /// A bank of white fog.
    Fog,
}

/// A chessboard that lies level on the ground, with a white margin of one square.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoardConfig {
    /// Where its middle lies.
    pub east_m: f64,
    /// Where its middle lies.
    pub north_m: f64,
    /// Inner corners along its longer side.
    pub columns: u32,
    /// Inner corners along its shorter side.
    pub rows: u32,
    /// Side of a square.
    pub square_m: f64,
    /// Its longer side from east towards north.
    #[serde(default)]
    pub turn_deg: f64,
}

impl BoardConfig {
    /// Of the printed side above the ground, metres.
    pub const THICKNESS_M: f64 = 0.03;
}

/// Trees and bushes, strewn at random.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TreesConfig {
    /// How many.
    pub count: u32,
    /// Which places.
    pub seed: u64,
    /// Mean height.
    pub height_m: f64,
    /// Half side of the square about the datum that they stand in.
    pub spread_m: f64,
    /// None stands nearer than this to a fire, a smoke or a lookalike.
    pub clearance_m: f64,
}

impl Default for TreesConfig {
    fn default() -> Self {
        Self {
            count: 0,
            seed: 1,
            height_m: 5.0,
            spread_m: 150.0,
            clearance_m: 6.0,
        }
    }
}

/// Sun and sky.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LightConfig {
    /// Clockwise from north.
    pub sun_azimuth_deg: f64,
    /// Above the horizon.
    pub sun_elevation_deg: f64,
    /// Direct light; 1 is a clear noon, 0 an overcast sky.
    pub sun: f64,
    /// Light of the sky; 1 is a clear noon.
    pub ambience: f64,
    /// At which range haze hides two thirds of the contrast.
    pub visibility_m: f64,
}

impl Default for LightConfig {
    fn default() -> Self {
        Self {
            sun_azimuth_deg: 150.0,
            sun_elevation_deg: 45.0,
            sun: 1.0,
            ambience: 1.0,
            visibility_m: 4000.0,
        }
    }
}

/// Where the air goes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WindConfig {
    /// Towards east.
    pub east_m_s: f64,
    /// Towards north.
    pub north_m_s: f64,
}

impl Default for WindConfig {
    fn default() -> Self {
        Self {
            east_m_s: 1.0,
            north_m_s: 0.5,
        }
    }
}
