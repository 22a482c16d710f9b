//! A fire's extent on the ground and how its front moves, from the outlines of many looks.
//!
//! **In:** [`Look`]s, the fire's near edge with its error, the wind if the autopilot states one.
//! **Out:** [`Extent`]: width and height with errors, the ground that burns as a polygon with its
//! error, direction and speed of the head with errors.
//!
//! **How.** A running fire is taken for an ellipse with the place of ignition in its rear focus
//! (the usual shape of fire-spread models: Alexander 1985), which keeps its shape while it grows. In
//! a direction at the angle a from the head its front stands at `H (e cos a + sqrt(1 - e² sin² a))`;
//! `H` grows with the rate `A`, the head runs with `A (1 + e)`. For each direction of the head and
//! each eccentricity on a grid, place, `H` and `A` follow by weighted least squares; the
//! grid nodes are weighed by how well they explain the looks, so that what the looks can't tell
//! (the far side of a fire seen from one side) is wide in the answer. Metres are worked out anew
//! from the present range each time: a range that gets better does not look like growth.
//!
//! **Known limits.** One head per fire. A sharp turn of the front is averaged over [`WINDOW_S`].

use super::outline::{InMetres, Look};
use emberfix_frames::{ServiceTime, Vector3};
use nalgebra::{Matrix4, Vector2, Vector4};
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

/// Seconds of looks that are used.
pub const WINDOW_S: f64 = 40.0;
/// Seconds between two looks that are kept, at least: nearer ones say the same.
const SPACING_S: f64 = 0.25;
/// Looks that are kept at most.
const MOST_LOOKS: usize = 160;
/// Looks from which an extent is told, and from which a spread is.
const LEAST_LOOKS: usize = 6;
const LEAST_SPREAD_LOOKS: usize = 16;
/// Seconds that those span at least.
const LEAST_SPREAD_S: f64 = 6.0;
/// Seconds of looks that say how large it is now.
const SIZE_S: f64 = 10.0;
/// A box against the flame that it is of, wide and high, and how far that differs from fire to
/// fire: glow widens it, sway and puffs reach beyond the mean.
const BOX_OVER_FLAME: (f64, f64) = (1.0, 1.0);
const BOX_SIGMA: f64 = 0.1;
/// Depth of a fire's bed against its width, when nothing better is known.
const BED_DEPTH: f64 = 0.6;
/// Spread is told from this many sigmas.
const SURE: f64 = 2.5;
/// Prior of the rate A, m/s, and of place and size, metres: far wider than any of them.
const RATE_PRIOR: f64 = 3.0;
const PLACE_PRIOR: f64 = 50.0;

/// The looks at one fire. Bound: [`MOST_LOOKS`]; the oldest goes first.
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
        let anchor = standing.foot.xy();
        let now = self.looks.back()?.at;
        let seconds = |at: ServiceTime| (at - now).as_secs_f64();
        let looks: Vec<(f64, InMetres)> = self
            .looks
            .iter()
            .filter_map(|look| Some((seconds(look.at), look.in_metres(&standing.foot, &anchor)?)))
            .collect();
        if looks.len() < LEAST_LOOKS {
            return None;
        }
        let width_m = side(&looks, standing, |look| look.width_m / BOX_OVER_FLAME.0)?;
        let shape = self.shape(&looks, wind);
        let height_m = side(&looks, standing, |look| {
            let depth = shape.as_ref().map_or(BED_DEPTH * width_m.value, |shape| {
                shape.depth_m(&look.sight)
            });
            (look.apparent_height_m - depth * look.slope).max(0.3 * look.apparent_height_m)
                / BOX_OVER_FLAME.1
        })?;
        let shape = shape.unwrap_or_else(|| Shape::disc(&looks, &width_m));
        Some(shape.told(anchor, width_m, height_m, standing))
    }

    fn shape(&self, looks: &[(f64, InMetres)], wind: Option<&Wind>) -> Option<Shape> {
        let enough = looks.len() >= LEAST_SPREAD_LOOKS && self.span_s() >= LEAST_SPREAD_S;
        enough.then(|| Shape::fit(looks, wind)).flatten()
    }
}

/// One side of the fire now: a line through the last seconds, and its error.
fn side(
    looks: &[(f64, InMetres)],
    standing: &Standing,
    of: impl Fn(&InMetres) -> f64,
) -> Option<Measured> {
    let recent = looks.iter().filter(|(t, _)| *t >= -SIZE_S);
    let points: Vec<(f64, f64)> = recent.map(|(t, look)| (*t, of(look))).collect();
    let line = Line::through(&points)?;
    let pixel = looks.last().map_or(0.0, |(_, look)| look.range_m * 1e-3);
    let systematic = line.value * standing.range_share.hypot(BOX_SIGMA);
    Some(Measured {
        value: line.value,
        sigma: line.value_sigma.hypot(systematic).hypot(pixel),
    })
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

/// One node of the grid: head, eccentricity, and what follows for them.
#[derive(Debug, Clone, Copy)]
struct Node {
    head: Vector2<f64>,
    eccentricity: f64,
    /// East and north of the focus from the anchor, H now, A.
    solved: Vector4<f64>,
    covariance: Matrix4<f64>,
    weight: f64,
}

/// What the looks say about the oval.
#[derive(Debug, Clone)]
struct Shape {
    nodes: Vec<Node>,
    used_wind: bool,
}

const HEADS: usize = 48;
const ECCENTRICITIES: [f64; 7] = [0.0, 0.3, 0.5, 0.65, 0.78, 0.87, 0.93];

/// Front of the oval of H = 1 in a direction.
fn oval(head: &Vector2<f64>, eccentricity: f64, outwards: &Vector2<f64>) -> f64 {
    let (along, across) = (head.dot(outwards), head.perp(outwards));
    eccentricity * along + (1.0 - (eccentricity * across).powi(2)).max(0.0).sqrt()
}

/// One reach, ready for the grid.
struct Row {
    t_s: f64,
    outwards: Vector2<f64>,
    metres: f64,
    weight: f64,
}

impl Shape {
    fn fit(looks: &[(f64, InMetres)], wind: Option<&Wind>) -> Option<Self> {
        let mut rows: Vec<Row> = looks
            .iter()
            .flat_map(|(t_s, look)| look.reaches.iter().flatten().map(|reach| (*t_s, *reach)))
            .map(|(t_s, reach)| Row {
                t_s,
                outwards: reach.outwards,
                metres: reach.metres,
                weight: reach.sigma_m.powi(-2),
            })
            .collect();
        let first = Self::over_grid(&rows, None)?;
        // The looks' own scatter about the best oval, and how alike neighbours are, say how much
        // each of them is worth.
        let worth = first.worth_of_a_look(&rows);
        for row in &mut rows {
            row.weight *= worth;
        }
        Self::over_grid(&rows, wind)
    }

    fn over_grid(rows: &[Row], wind: Option<&Wind>) -> Option<Self> {
        let mut nodes = Vec::with_capacity(HEADS * ECCENTRICITIES.len());
        for k in 0..HEADS {
            let azimuth = std::f64::consts::TAU * k as f64 / HEADS as f64;
            let head = Vector2::new(azimuth.sin(), azimuth.cos());
            for eccentricity in ECCENTRICITIES {
                nodes.extend(Node::solve(rows, head, eccentricity, wind));
            }
        }
        let best = nodes
            .iter()
            .map(|node| node.weight)
            .fold(f64::MIN, f64::max);
        for node in &mut nodes {
            node.weight = (node.weight - best).exp();
        }
        let total: f64 = nodes.iter().map(|node| node.weight).sum();
        for node in &mut nodes {
            node.weight /= total;
        }
        nodes.retain(|node| node.weight > 1e-6);
        let used_wind = wind.is_some();
        (!nodes.is_empty()).then_some(Self { nodes, used_wind })
    }

    /// A fire that is not known to run: a disc as wide as the fire, behind its near edge.
    fn disc(looks: &[(f64, InMetres)], width_m: &Measured) -> Self {
        let sight = looks.last().map_or(Vector2::y(), |(_, look)| look.sight);
        let centre = sight * (0.5 * BED_DEPTH * width_m.value);
        let sigmas = Vector4::new(
            0.3 * width_m.value,
            0.3 * width_m.value,
            width_m.sigma / 2.0,
            0.0,
        );
        let node = Node {
            head: Vector2::y(),
            eccentricity: 0.0,
            solved: Vector4::new(centre.x, centre.y, width_m.value / 2.0, 0.0),
            covariance: Matrix4::from_diagonal(&sigmas.map(|s| s * s)),
            weight: 1.0,
        };
        Self {
            nodes: vec![node],
            used_wind: false,
        }
    }

    fn best(&self) -> &Node {
        let heavier = |a: &&Node, b: &&Node| a.weight.total_cmp(&b.weight);
        // There is always one: `over_grid` and `disc` see to it.
        self.nodes.iter().max_by(heavier).unwrap_or(&self.nodes[0])
    }

    /// Factor on every row's weight.
    fn worth_of_a_look(&self, rows: &[Row]) -> f64 {
        let best = self.best();
        let left: Vec<f64> = rows
            .iter()
            .map(|row| (row.metres - best.front(row)) * row.weight.sqrt())
            .collect();
        let variance = left.iter().map(|r| r * r).sum::<f64>() / (left.len() as f64 - 6.0).max(1.0);
        // Neighbours of one kind stand up to three rows apart.
        let lag = 3.min(left.len().saturating_sub(1));
        let power: f64 = left.iter().map(|r| r * r).sum();
        let lagged: f64 = left.iter().zip(&left[lag..]).map(|(a, b)| a * b).sum();
        let alike = (lagged / power.max(1e-12)).clamp(0.0, 0.95);
        1.0 / (variance.max(0.05) * (1.0 + alike) / (1.0 - alike))
    }

    fn mean(&self, of: impl Fn(&Node) -> f64) -> f64 {
        self.nodes.iter().map(|node| node.weight * of(node)).sum()
    }

    /// Mean over the nodes, with the variance between them and within each.
    fn measured(&self, of: impl Fn(&Node) -> f64, within: impl Fn(&Node) -> f64) -> Measured {
        let value = self.mean(&of);
        let variance = self.mean(|node| (of(node) - value).powi(2) + within(node));
        Measured {
            value,
            sigma: variance.max(0.0).sqrt(),
        }
    }

    /// From the near edge to the far one along a line of sight.
    fn depth_m(&self, sight: &Vector2<f64>) -> f64 {
        self.mean(|node| node.solved[2] * (node.oval(sight) + node.oval(&-sight)))
    }

    fn spread(&self, standing: &Standing) -> Option<SpreadTold> {
        let speed = self.measured(
            |node| node.solved[3] * (1.0 + node.eccentricity),
            |node| node.covariance[(3, 3)] * (1.0 + node.eccentricity).powi(2),
        );
        let speed = Measured {
            sigma: speed.sigma.hypot(speed.value * standing.range_share),
            ..speed
        };
        if speed.value < SURE * speed.sigma {
            return None;
        }
        // An oval that does not point anywhere has no direction.
        let pull = |node: &Node| node.weight * node.eccentricity;
        let total: f64 = self.nodes.iter().map(pull).sum();
        let mean = self
            .nodes
            .iter()
            .map(|node| node.head * pull(node))
            .sum::<Vector2<f64>>()
            / total.max(1e-9);
        let length = mean.norm().clamp(1e-6, 1.0);
        let step = std::f64::consts::TAU / HEADS as f64;
        // Circular standard deviation, and the grid's own width.
        let sigma = (-2.0 * length.ln())
            .max(0.0)
            .sqrt()
            .hypot(step / 12.0_f64.sqrt());
        (total > 0.0).then(|| SpreadTold {
            azimuth_deg: Measured {
                value: mean.x.atan2(mean.y).to_degrees().rem_euclid(360.0),
                sigma: sigma.to_degrees(),
            },
            speed_m_s: speed,
            used_wind: self.used_wind,
        })
    }

    fn told(
        &self,
        anchor: Vector2<f64>,
        width_m: Measured,
        height_m: Measured,
        standing: &Standing,
    ) -> Extent {
        let best = self.best();
        let spread = self.spread(standing);
        let corner = |k: usize| best.corner(std::f64::consts::TAU * k as f64 / CORNERS as f64);
        let polygon_m: Vec<Vector2<f64>> = (0..CORNERS).map(|k| anchor + corner(k).0).collect();
        let runs = |k: &usize| corner(*k).1 >= 0.5 * (1.0 + best.eccentricity);
        let front = (0..CORNERS).filter(runs).map(|k| polygon_m[k]).collect();
        let edge = self.measured(
            |node| node.solved[2] * (1.0 + node.eccentricity),
            |node| node.covariance[(2, 2)] + node.covariance[(0, 0)].max(node.covariance[(1, 1)]),
        );
        let edge_sigma_m = edge
            .sigma
            .hypot(width_m.value / 2.0 * standing.range_share.hypot(BOX_SIGMA));
        let area = self.measured(Node::area_m2, |_| 0.0);
        let relative = 2.0 * edge_sigma_m / (area.value.max(1e-6) / std::f64::consts::PI).sqrt();
        Extent {
            area_m2: Measured {
                value: area.value,
                sigma: area.sigma.hypot(area.value * relative.min(1.0)),
            },
            level_m: standing.foot.z,
            polygon_m,
            edge_sigma_m,
            front: if spread.is_some() { front } else { Vec::new() },
            spread,
            width_m,
            height_m,
        }
    }
}

/// Corners of the told polygon.
const CORNERS: usize = 24;

impl Node {
    fn solve(
        rows: &[Row],
        head: Vector2<f64>,
        eccentricity: f64,
        wind: Option<&Wind>,
    ) -> Option<Self> {
        let prior = Vector4::new(PLACE_PRIOR, PLACE_PRIOR, PLACE_PRIOR, RATE_PRIOR);
        let mut information = Matrix4::from_diagonal(&prior.map(|sigma| sigma.powi(-2)));
        let mut right = Vector4::zeros();
        let mut squares = 0.0;
        for row in rows {
            let oval = oval(&head, eccentricity, &row.outwards);
            let by = Vector4::new(row.outwards.x, row.outwards.y, oval, oval * row.t_s);
            information += by * by.transpose() * row.weight;
            right += by * (row.metres * row.weight);
            squares += row.metres * row.metres * row.weight;
        }
        let cholesky = information.cholesky()?;
        let solved = cholesky.solve(&right);
        let log_determinant: f64 = cholesky.l().diagonal().iter().map(|d| 2.0 * d.ln()).sum();
        let misfit = squares - solved.dot(&right);
        let is_a_fire = solved[2] > 0.0;
        is_a_fire.then(|| Self {
            head,
            eccentricity,
            solved,
            covariance: cholesky.inverse(),
            weight: -0.5 * (misfit + log_determinant) + downwind(&head, eccentricity, wind),
        })
    }

    fn oval(&self, outwards: &Vector2<f64>) -> f64 {
        oval(&self.head, self.eccentricity, outwards)
    }

    fn front(&self, row: &Row) -> f64 {
        let size = self.solved[2] + self.solved[3] * row.t_s;
        self.solved.xy().dot(&row.outwards) + size * self.oval(&row.outwards)
    }

    fn area_m2(&self) -> f64 {
        let e = self.eccentricity;
        std::f64::consts::PI * self.solved[2].powi(2) * (1.0 - e * e).sqrt()
    }

    /// A corner of the oval from the anchor, and how fast the front runs there against A.
    fn corner(&self, angle: f64) -> (Vector2<f64>, f64) {
        let e = self.eccentricity;
        let left = Vector2::new(-self.head.y, self.head.x);
        let (wide, size) = ((1.0 - e * e).sqrt(), self.solved[2]);
        let (x, y) = (e + angle.cos(), wide * angle.sin());
        let outwards = (self.head * (wide * angle.cos()) + left * angle.sin()).normalize();
        (
            self.solved.xy() + (self.head * x + left * y) * size,
            self.oval(&outwards),
        )
    }
}

/// Log of the prior: fires run before the wind, the surer the stronger it blows.
fn downwind(head: &Vector2<f64>, eccentricity: f64, wind: Option<&Wind>) -> f64 {
    let Some(wind) = wind else {
        return 0.0;
    };
    let speed = wind.towards_m_s.norm();
    if speed < 1e-6 {
        return 0.0;
    }
    let doubt = (wind.sigma_m_s / speed).hypot(0.6);
    let angle = head
        .perp(&wind.towards_m_s)
        .atan2(head.dot(&wind.towards_m_s));
    // A round fire has no head.
    -0.5 * (angle / doubt).powi(2) * eccentricity
}
