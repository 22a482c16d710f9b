//! What an alarm says of how a fire burns: added to the contract's properties, all of it optional.

use super::SizeM;
use crate::assess::extent::{Measured, SizeClass, SpreadTold};
use serde::{Deserialize, Serialize};

/// Properties beside `size_m` and `trend`. An alarm of an older aircraft has none of them.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Burning {
    /// One sigma of `size_m`.
    pub size_sigma_m: Option<SizeM>,
    /// By metres, whatever the range.
    pub size_class: Option<SizeClass>,
    /// One sigma of `trend`, per second.
    pub trend_sigma: Option<f64>,
    /// Probability that it grows, and that it dies.
    pub trend_probability: Option<TrendProbability>,
    /// Brightness, 1 when the fire was first assessed.
    pub intensity: Option<Measured>,
    /// Seconds before `captured_at` (negative) and intensity then, in time order, at most 24 points.
    pub intensity_history: Vec<[f64; 2]>,
    /// Burning ground.
    pub area: Option<Area>,
    /// Where the front runs and how fast, once that is beyond doubt.
    pub spread: Option<SpreadTold>,
}

/// Probabilities of what a fire does; what is missing to 1 is that it is steady.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TrendProbability {
    /// That it grows.
    pub growing: f64,
    /// That it dies.
    pub dying: f64,
}

/// Burning ground as a polygon.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Area {
    /// Corners as longitude and latitude, anticlockwise; the last is joined to the first.
    pub polygon: Vec<[f64; 2]>,
    /// One sigma of its edge against the fire's position, metres.
    pub edge_sigma_m: f64,
    /// m².
    pub square_metres: Measured,
    /// Corners that run ahead, the front line; empty when nothing runs.
    pub front: Vec<[f64; 2]>,
}
