//! A fire's extent on the ground and how its front moves, from the outlines of many looks.
//!
//! **In:** [`Look`]s, the fire's near edge with its error, the wind if the autopilot states one.
//! **Out:** [`Extent`]: width and height with errors, the ground that burns as a polygon with its
//! error, direction and speed of the head with errors.
//!
//! **How.** Width is a line through the last seconds, [`height`](super::height) takes what depth and
//! lean add off the box's height, and `front` fits one burning body to the planes of
//! all boxes: ground, direction and speed. Metres are worked out anew from the present range each
//! time: a range that gets better does not look like growth.
//!
//! **Known limits.** One head per fire. A sharp turn of the front is averaged over [`WINDOW_S`].
//! Within 20 m, a front moves in that time about as far as a reported camera wanders: few heads are told
//! there, most of them with the wind's help.

use super::front::Shape;
use super::outline::{InMetres, Look};
use emberfix_frames::{ServiceTime, Vector3};
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// A value and one sigma of its error, in the same unit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// The value.
    pub value: f64,
    /// One sigma.
    pub sigma: f64,
}

/// Where the air goes, and how surely that is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wind {
    /// East, north, m/s.
    pub towards_m_s: Vector2<f64>,
    /// One sigma per axis, m/s.
    pub sigma_m_s: f64,
}

/// Direction and speed of the head over the ground.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SpreadTold {
    /// Clockwise from north, degrees; one sigma in degrees.
    pub azimuth_deg: Measured,
    /// m/s.
    pub speed_m_s: Measured,
    /// Whether the wind's direction went into it.
    pub used_wind: bool,
}

/// How large a fire is and how it runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Extent {
    /// Across the line of sight, metres.
    pub width_m: Measured,
    /// Of the flames, upwards, metres.
    pub height_m: Measured,
    /// Level of the ground there, up in the mission plane, metres.
    pub level_m: f64,
    /// Corners of the burning ground, east and north in the mission plane, anticlockwise.
    pub polygon_m: Vec<Vector2<f64>>,
    /// One sigma of the polygon's edge, metres, without the error of the fire's position.
    pub edge_sigma_m: f64,
    /// Burning ground, m².
    pub area_m2: Measured,
    /// How the head runs, when it does so beyond doubt.
    pub spread: Option<SpreadTold>,
    /// Corners of the polygon that run with at least half the head's speed; empty without spread.
    pub front: Vec<Vector2<f64>>,
}

/// Distance-aware size of a fire, by its greater side in metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SizeClass {
    /// Below 1 m: one person puts it out.
    Small,
    /// 1 to 5 m.
    Medium,
    /// 5 m and more.
    Large,
}

impl SizeClass {
    /// The class of a width and height, metres.
    #[must_use]
    pub fn of(width_m: f64, height_m: f64) -> Self {
        match width_m.max(height_m) {
            side if side < 1.0 => Self::Small,
            side if side < 5.0 => Self::Medium,
            _ => Self::Large,
        }
    }
}

impl Extent {
    /// Its class: by its width alone where the height is not known. From above, the flames of a deep fire
    /// can't be told from its far side.
    #[must_use]
    pub fn class(&self) -> SizeClass {
        let height = self.height_m;
        let height_m = if height.is_known() { height.value } else { 0.0 };
        SizeClass::of(self.width_m.value, height_m)
    }
}

/// Share of a value that its sigma is at most, where it counts as known.
pub const KNOWN: f64 = 0.3;
/// Seconds of looks that are used.
pub const WINDOW_S: f64 = 40.0;
/// Seconds between two looks that are kept, at least: nearer ones say the same.
const SPACING_S: f64 = 0.25;
/// Looks that are kept at most.
const MOST_LOOKS: usize = 160;
/// Looks from which an extent is told.
const LEAST_LOOKS: usize = 6;
/// Looks, seconds and degrees of view from which an oval is fitted: from one side, the far side of a
/// fire and the speed of its head can't be told.
const LEAST_OVAL_LOOKS: usize = 16;
const LEAST_OVAL_S: f64 = 8.0;
const LEAST_OVAL_DEG: f64 = 75.0;
/// Seconds of looks that say how wide and how high it is now.
const WIDTH_S: f64 = 10.0;
const HEIGHT_S: f64 = 12.0;
/// How far a box's side differs from its flame's for as long as we look: a detector's habits, glow.
const BOX_SIGMA: f64 = 0.042;
/// Depth of a fire against its width when it was seen from one side only, and one sigma of that share.
const DEPTH: f64 = 1.0;
const DEPTH_SIGMA: f64 = 0.35;
/// Spread is told from this many sigmas of its speed, and below this sigma of its direction.
const SURE: f64 = 3.0;
const SURE_DEG: f64 = 15.0;
/// Probability of running the other way from which no direction is told.
const BACKWARDS: f64 = 3e-3;
/// Degrees of view from which a head is told. Sides of boxes are bearings: from less, a front that runs
/// while we turn about it looks like one that runs the other way beside it.
pub const LEAST_HEAD_DEG: f64 = 100.0;
/// Errors of speed and direction against the sigmas that follow from the grid of ovals, which holds more
/// of them than burn. Settled on seeds 31 and 32 of `emberfix eval trend`, on which nothing else was: with 0.70,
/// which the seeds of the priors ask for, `--seed 31` printed a `spread.coverage90` of 0.857. The seed that
/// it reports without being asked is another.
const GRID_SIGMA: f64 = 0.80;
/// Share of the depth that the oval itself is wrong by: fires are no ellipses.
const DEPTH_SHARE: f64 = 0.1;
/// Seconds between two looks that the front is fitted to, at least: nearer ones say the same.
const FRONT_SPACING_S: f64 = 0.7;
/// Corners of the told polygon.
const CORNERS: usize = 24;
/// A corner that runs with this share of the head's speed is of the front line.
const FRONT_SHARE: f64 = 0.5;

/// The looks at one fire. Bound: `MOST_LOOKS`; the oldest goes first.
#[derive(Debug, Clone, Default)]
pub struct Outline {
    looks: VecDeque<Look>,
    asked: Option<ServiceTime>,
}

/// The fire's near edge and what is known of its range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Standing {
    /// Mission plane, metres.
    pub foot: Vector3<f64>,
    /// One sigma of the range, as a share of it.
    pub range_share: f64,
    /// How far the reported camera wanders against the ground, across and upwards, metres per square
    /// root of a second: it makes a fire seem to move.
    pub wander_m: (f64, f64),
    /// One sigma of heading and of tilt, radians.
    pub turn_rad: (f64, f64),
}

impl Outline {
    /// Whether `every_s` have passed since the last time that this was true.
    pub fn is_due(&mut self, at: ServiceTime, every_s: f64) -> bool {
        let due = self
            .asked
            .is_none_or(|last| (at - last).as_secs_f64() >= every_s);
        if due {
            self.asked = Some(at);
        }
        due
    }

    /// Takes one look in.
    pub fn add(&mut self, look: Look) {
        let last = self.looks.back();
        if last.is_some_and(|last| (look.at - last.at).as_secs_f64() < SPACING_S) {
            return;
        }
        self.looks.push_back(look);
        while self.looks.len() > MOST_LOOKS || self.span_s() > WINDOW_S {
            self.looks.pop_front();
        }
    }

    fn span_s(&self) -> f64 {
        match (self.looks.front(), self.looks.back()) {
            (Some(first), Some(last)) => (last.at - first.at).as_secs_f64(),
            _ => 0.0,
        }
    }

    /// The extent at the latest look; `None` before there are enough.
    #[must_use]
    pub fn extent(&self, standing: &Standing, wind: Option<&Wind>) -> Option<Extent> {
        let mut depth = Measured {
            value: 0.0,
            sigma: 0.0,
        };
        let mut looks = self.in_metres(standing, depth.value)?;
        let width = Line::through(&recent(&looks, WIDTH_S, |look| look.width_m))?.value;
        depth = Measured {
            value: DEPTH * width,
            sigma: DEPTH_SIGMA * width,
        };
        let shape = self
            .shows_an_oval(&looks)
            .then(|| Shape::fit(&self.spaced(), standing, wind))
            .flatten();
        if let (Some(shape), Some((_, last))) = (&shape, looks.last()) {
            depth = shape.depth_m(&last.sight).or_share(DEPTH_SHARE);
        }
        looks = self.in_metres(standing, depth.value)?;
        let width_m = width_of(&looks, standing, &depth)?;
        let height_m = super::height::height(&recent_looks(&looks, HEIGHT_S), &depth, wind)?
            .or_share(standing.range_share.hypot(BOX_SIGMA));
        let runs = shape.is_some() && view_deg(&looks) >= LEAST_HEAD_DEG;
        let shape = shape.unwrap_or_else(|| behind(&looks, &width_m));
        Some(told(&shape, runs, standing, width_m, height_m))
    }

    /// The looks that the front is fitted to, with their seconds before the latest.
    fn spaced(&self) -> Vec<(f64, &Look)> {
        let mut spaced: Vec<(f64, &Look)> = Vec::new();
        let Some(last) = self.looks.back() else {
            return spaced;
        };
        // Counted from the newest, so that it is always among them.
        for look in self.looks.iter().rev() {
            let t_s = (look.at - last.at).as_secs_f64();
            if spaced
                .last()
                .is_none_or(|(after, _)| after - t_s >= FRONT_SPACING_S - 0.05)
            {
                spaced.push((t_s, look));
            }
        }
        spaced.reverse();
        spaced
    }

    fn in_metres(&self, standing: &Standing, depth_m: f64) -> Option<Vec<(f64, InMetres)>> {
        let last = self.looks.back()?;
        let middle = last.middle(&standing.foot, depth_m);
        let in_metres = |look: &Look| {
            let metres = look.in_metres(&middle, depth_m)?;
            Some(((look.at - last.at).as_secs_f64(), metres))
        };
        let looks: Vec<(f64, InMetres)> = self.looks.iter().filter_map(in_metres).collect();
        (looks.len() >= LEAST_LOOKS).then_some(looks)
    }

    fn shows_an_oval(&self, looks: &[(f64, InMetres)]) -> bool {
        looks.len() >= LEAST_OVAL_LOOKS
            && self.span_s() >= LEAST_OVAL_S
            && view_deg(looks) >= LEAST_OVAL_DEG
    }
}

/// A fire that was seen from one side: a disc as wide as the fire, behind its near edge.
fn behind(looks: &[(f64, InMetres)], width_m: &Measured) -> Shape {
    let sight = looks.last().map_or(Vector2::y(), |(_, look)| look.sight);
    let radius = Measured {
        value: width_m.value / 2.0,
        sigma: width_m.sigma / 2.0,
    };
    let centre = sight * (DEPTH * radius.value);
    Shape::disc(centre, DEPTH_SIGMA * radius.value, &radius)
}

fn told(
    shape: &Shape,
    may_run: bool,
    standing: &Standing,
    width_m: Measured,
    height_m: Measured,
) -> Extent {
    let corners = shape.corners(CORNERS);
    let anchor = standing.foot.xy();
    let spread = may_run.then(|| spread(shape)).flatten();
    let runs = |(_, speed): &&(Vector2<f64>, f64)| spread.is_some() && *speed >= FRONT_SHARE;
    let at = |(corner, _): &(Vector2<f64>, f64)| anchor + corner;
    let polygon_m: Vec<Vector2<f64>> = corners.iter().map(at).collect();
    let share = standing.range_share.hypot(BOX_SIGMA);
    let area = area_m2(&polygon_m);
    Extent {
        front: corners.iter().filter(runs).map(at).collect(),
        area_m2: Measured {
            value: area,
            sigma: area * shape.area_share(),
        }
        .or_share(2.0 * share),
        level_m: standing.foot.z,
        edge_sigma_m: shape.edge_sigma_m().hypot(width_m.value / 2.0 * share),
        polygon_m,
        spread,
        width_m,
        height_m,
    }
}

/// How the head runs, when it does so beyond doubt.
fn spread(shape: &Shape) -> Option<SpreadTold> {
    let heading = shape.heading()?;
    let speed_m_s = shape.speed_m_s().with_sigma_times(GRID_SIGMA);
    let azimuth_deg = heading.azimuth_deg.with_sigma_times(GRID_SIGMA);
    let sure = speed_m_s.value > SURE * speed_m_s.sigma
        && azimuth_deg.sigma < SURE_DEG
        && heading.backwards < BACKWARDS;
    sure.then_some(SpreadTold {
        azimuth_deg,
        speed_m_s,
        used_wind: shape.used_wind(),
    })
}

/// Of a polygon, anticlockwise.
fn area_m2(corners: &[Vector2<f64>]) -> f64 {
    let next = corners.iter().cycle().skip(1);
    let twice: f64 = corners.iter().zip(next).map(|(a, b)| a.perp(b)).sum();
    twice.abs() / 2.0
}

/// Degrees over which the fire was looked at.
fn view_deg(looks: &[(f64, InMetres)]) -> f64 {
    let mean: Vector2<f64> = looks.iter().map(|(_, look)| look.sight).sum();
    let angles = looks
        .iter()
        .map(|(_, look)| mean.perp(&look.sight).atan2(mean.dot(&look.sight)));
    let (low, high) = angles.fold((0.0_f64, 0.0_f64), |(low, high), angle| {
        (low.min(angle), high.max(angle))
    });
    (high - low).to_degrees()
}

fn recent_looks(looks: &[(f64, InMetres)], seconds: f64) -> Vec<(f64, InMetres)> {
    looks
        .iter()
        .filter(|(t, _)| *t >= -seconds)
        .copied()
        .collect()
}

fn recent(
    looks: &[(f64, InMetres)],
    seconds: f64,
    of: impl Fn(&InMetres) -> f64,
) -> Vec<(f64, f64)> {
    let recent = looks.iter().filter(|(t, _)| *t >= -seconds);
    recent.map(|(t, look)| (*t, of(look))).collect()
}

/// Width now: a line through the last seconds, with what the range, the box and the depth at which
/// its sides are seen may be wrong by.
fn width_of(looks: &[(f64, InMetres)], standing: &Standing, depth: &Measured) -> Option<Measured> {
    let line = Line::through(&recent(looks, WIDTH_S, |look| look.width_m))?;
    let flat_m = looks.last()?.1.flat_m;
    let share = standing
        .range_share
        .hypot(BOX_SIGMA)
        .hypot(0.5 * depth.sigma / flat_m);
    Some(Measured {
        value: line.value,
        sigma: line.value_sigma.hypot(line.value * share),
    })
}

impl Measured {
    /// Whether it may be told as known: its sigma is at most [`KNOWN`] of it.
    #[must_use]
    pub fn is_known(&self) -> bool {
        self.sigma <= KNOWN * self.value
    }

    fn with_sigma_times(self, factor: f64) -> Self {
        Self {
            sigma: factor * self.sigma,
            ..self
        }
    }

    /// With an error that is a share of the value, beside its own.
    fn or_share(self, share: f64) -> Self {
        Self {
            sigma: self.sigma.hypot(self.value * share),
            ..self
        }
    }
}

/// A least-squares line: its value at time 0 and its slope, with errors that know that neighbours
/// are alike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Line {
    /// At time 0.
    pub value: f64,
    /// One sigma.
    pub value_sigma: f64,
    /// Per second.
    pub slope: f64,
    /// One sigma.
    pub slope_sigma: f64,
}

impl Line {
    /// Through points (seconds, value) in time order; `None` for fewer than four, or all at one time.
    #[must_use]
    pub fn through(points: &[(f64, f64)]) -> Option<Self> {
        let n = points.len() as f64;
        if points.len() < 4 {
            return None;
        }
        let mean = |of: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / n;
        let (t, y) = (mean(&|p| p.0), mean(&|p| p.1));
        let sxx = n * mean(&|p| (p.0 - t).powi(2));
        if sxx <= 1e-9 {
            return None;
        }
        let slope = n * mean(&|p| (p.0 - t) * (p.1 - y)) / sxx;
        let left: Vec<f64> = points.iter().map(|p| p.1 - y - slope * (p.0 - t)).collect();
        let variance = left.iter().map(|r| r * r).sum::<f64>() / (n - 2.0);
        let alike = likeness(&left);
        // First-order correlated noise: so many fewer points that say something of their own.
        let variance = variance * ((1.0 + alike) / (1.0 - alike)).min(n / 2.0);
        Some(Self {
            value: y - slope * t,
            value_sigma: (variance * (1.0 / n + t * t / sxx)).sqrt(),
            slope,
            slope_sigma: (variance / sxx).sqrt(),
        })
    }
}

/// Correlation of neighbours, 0 to 0.95.
fn likeness(left: &[f64]) -> f64 {
    let power: f64 = left.iter().map(|r| r * r).sum();
    let lagged: f64 = left.windows(2).map(|pair| pair[0] * pair[1]).sum();
    if power <= 0.0 {
        return 0.0;
    }
    (lagged / power).clamp(0.0, 0.95)
}
