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

use super::outline::{InMetres, Look, Reach};
use emberfix_frames::{ServiceTime, Vector3};
use nalgebra::{SMatrix, SVector, Vector2};
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
const BOX_SIGMA: f64 = 0.06;
/// Depth of a fire against its width when it was seen from one side only, and one sigma of that share.
const DEPTH: f64 = 1.0;
const DEPTH_SIGMA: f64 = 0.4;
/// Spread is told from this many sigmas of its speed, and below this sigma of its direction.
const SURE: f64 = 3.0;
const SURE_DEG: f64 = 20.0;
/// Share of the speed, and degrees, that the oval itself is wrong by: fires are no ellipses.
const SPEED_SHARE: f64 = 0.2;
const DIRECTION_DEG: f64 = 5.0;
/// Share of the depth that it is wrong by for the same reason.
const DEPTH_SHARE: f64 = 0.1;
/// Prior of the rate A, m/s; it and the size are otherwise as likely in each octave.
const RATE_PRIOR: f64 = 3.0;
/// Slower than this nothing is told apart from standing still, m/s.
const STANDING_M_S: f64 = 0.05;

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
        let mut shape = None;
        if self.shows_an_oval(&looks) {
            // The sides are seen at half the depth, which the oval says only afterwards.
            for _ in 0..2 {
                looks = self.in_metres(standing, depth.value)?;
                let sight = looks.last()?.1.sight;
                shape = Shape::fit(&looks, standing, wind);
                depth = shape.as_ref().map_or(depth, |shape| shape.depth_m(&sight));
            }
        }
        looks = self.in_metres(standing, depth.value)?;
        let width_m = width_of(&looks, standing, &depth)?;
        let height_m = super::height::height(&recent_looks(&looks, HEIGHT_S), &depth, wind)?
            .or_share(standing.range_share.hypot(BOX_SIGMA));
        let shape = shape.unwrap_or_else(|| Shape::disc(&looks, &width_m));
        Some(shape.told(standing, width_m, height_m))
    }

    fn in_metres(&self, standing: &Standing, depth_m: f64) -> Option<Vec<(f64, InMetres)>> {
        let anchor = standing.foot.xy();
        let last = self.looks.back()?;
        let middle = last.middle(&standing.foot, depth_m);
        let in_metres = |look: &Look| {
            let metres = look.in_metres(&middle, depth_m, &anchor)?;
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

/// What is solved for at each node of the grid: place of the focus from the anchor (east, north), H
/// now, A, wander of the reported camera (east, north, up; m/s), offset of the near edge.
const UNKNOWNS: usize = 8;
const H: usize = 2;
const A: usize = 3;

/// One node of the grid: head, eccentricity, and what follows for them.
#[derive(Debug, Clone, Copy)]
struct Node {
    head: Vector2<f64>,
    eccentricity: f64,
    solved: SVector<f64, UNKNOWNS>,
    covariance: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    weight: f64,
}

/// What the looks say about the oval.
#[derive(Debug, Clone)]
struct Shape {
    nodes: Vec<Node>,
    used_wind: bool,
}

const HEADS: usize = 36;
/// Eccentricities and how likely each is beforehand: long ones need strong wind.
const ECCENTRICITIES: [(f64, f64); 7] = [
    (0.0, 3.0),
    (0.3, 2.5),
    (0.5, 2.0),
    (0.65, 1.5),
    (0.78, 1.0),
    (0.87, 0.6),
    (0.93, 0.3),
];

/// Front of the oval of H = 1 in a direction.
fn oval(head: &Vector2<f64>, eccentricity: f64, outwards: &Vector2<f64>) -> f64 {
    let (along, across) = (head.dot(outwards), head.perp(outwards));
    eccentricity * along + (1.0 - (eccentricity * across).powi(2)).max(0.0).sqrt()
}

/// One reach, ready for the grid.
#[derive(Debug, Clone, Copy)]
struct Row {
    t_s: f64,
    reach: Reach,
    weight: f64,
}

impl Row {
    /// The reach over the unknowns.
    fn by(&self, head: &Vector2<f64>, eccentricity: f64) -> SVector<f64, UNKNOWNS> {
        let (out, t_s) = (self.reach.outwards, self.t_s);
        let oval = oval(head, eccentricity, &out);
        let near = f64::from(u8::from(self.reach.by_height != 0.0));
        SVector::from([
            out.x,
            out.y,
            oval,
            oval * t_s,
            out.x * t_s,
            out.y * t_s,
            self.reach.by_height * t_s,
            near,
        ])
    }
}

/// What is known before the looks, as information.
fn prior(looks: &[(f64, InMetres)], standing: &Standing) -> SVector<f64, UNKNOWNS> {
    let range_m = looks.last().map_or(1.0, |(_, look)| look.range_m);
    let span_s = looks.first().map_or(1.0, |(t_s, _)| -t_s).max(1.0);
    // The slope of a random walk over a time, by least squares.
    let wander = |per_root_s: f64| (per_root_s * (1.2 / span_s).sqrt()).max(1e-3);
    let (across, up) = standing.wander_m;
    let sigmas = [
        range_m,
        range_m,
        range_m,
        RATE_PRIOR,
        wander(across),
        wander(across),
        wander(up),
        standing.range_share * range_m + 0.3,
    ];
    SVector::from(sigmas.map(|sigma: f64| sigma.powi(-2)))
}

impl Shape {
    fn fit(looks: &[(f64, InMetres)], standing: &Standing, wind: Option<&Wind>) -> Option<Self> {
        let prior = prior(looks, standing);
        let mut rows: Vec<Row> = looks
            .iter()
            .flat_map(|(t_s, look)| look.reaches.iter().flatten().map(|reach| (*t_s, *reach)))
            .map(|(t_s, reach)| Row {
                t_s,
                reach,
                weight: reach.sigma_m.powi(-2),
            })
            .collect();
        let first = Self::over_grid(&rows, &prior, None)?;
        // The looks' own scatter about the best oval, and how alike neighbours are, say how much
        // each of them is worth.
        let worth = first.worth_of_a_look(&rows);
        for row in &mut rows {
            row.weight *= worth;
        }
        Self::over_grid(&rows, &prior, wind)
    }

    fn over_grid(
        rows: &[Row],
        prior: &SVector<f64, UNKNOWNS>,
        wind: Option<&Wind>,
    ) -> Option<Self> {
        let mut nodes = Vec::with_capacity(HEADS * ECCENTRICITIES.len());
        for k in 0..HEADS {
            let azimuth = std::f64::consts::TAU * k as f64 / HEADS as f64;
            let head = Vector2::new(azimuth.sin(), azimuth.cos());
            for (eccentricity, likely) in ECCENTRICITIES {
                let node = Node::solve(rows, prior, head, eccentricity);
                nodes.extend(node.map(|mut node| {
                    node.weight += likely.ln() + downwind(&head, eccentricity, wind);
                    node
                }));
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

    /// A fire that was seen from one side: a disc as wide as the fire, behind its near edge.
    fn disc(looks: &[(f64, InMetres)], width_m: &Measured) -> Self {
        let sight = looks.last().map_or(Vector2::y(), |(_, look)| look.sight);
        let radius = width_m.value / 2.0;
        let mut solved = SVector::zeros();
        let centre = sight * (DEPTH * radius);
        (solved[0], solved[1], solved[H]) = (centre.x, centre.y, radius);
        let mut covariance = SMatrix::zeros();
        let far = DEPTH_SIGMA * width_m.value / 2.0;
        for (unknown, sigma) in [(0, far), (1, far), (H, width_m.sigma / 2.0)] {
            covariance[(unknown, unknown)] = sigma * sigma;
        }
        let node = Node {
            head: Vector2::y(),
            eccentricity: 0.0,
            solved,
            covariance,
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
            .map(|row| (row.reach.metres - best.front(row)) * row.weight.sqrt())
            .collect();
        let power: f64 = left.iter().map(|r| r * r).sum();
        let variance = power / (left.len() as f64 - UNKNOWNS as f64).max(1.0);
        // Neighbours of one kind stand up to three rows apart.
        let lag = 3.min(left.len().saturating_sub(1));
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
    fn depth_m(&self, sight: &Vector2<f64>) -> Measured {
        let across = |node: &Node| node.oval(sight) + node.oval(&-sight);
        self.measured(
            |node| node.solved[H] * across(node),
            |node| 4.0 * node.covariance[(H, H)],
        )
        .or_share(DEPTH_SHARE)
    }

    fn spread(&self, standing: &Standing) -> Option<SpreadTold> {
        let speed_m_s = self
            .measured(
                |node| node.solved[A] * (1.0 + node.eccentricity),
                |node| node.covariance[(A, A)] * (1.0 + node.eccentricity).powi(2),
            )
            .or_share(standing.range_share.hypot(SPEED_SHARE));
        let azimuth_deg = self.azimuth_deg()?;
        let sure = speed_m_s.value > SURE * speed_m_s.sigma && azimuth_deg.sigma < SURE_DEG;
        sure.then_some(SpreadTold {
            azimuth_deg,
            speed_m_s,
            used_wind: self.used_wind,
        })
    }

    /// Circular mean and deviation of the head, each node by how much it points; `None` for what
    /// points nowhere.
    fn azimuth_deg(&self) -> Option<Measured> {
        let total = self.mean(|node| node.eccentricity);
        if total <= 0.0 {
            return None;
        }
        let pulled = self.nodes.iter();
        let mean: Vector2<f64> = pulled
            .map(|node| node.head * (node.weight * node.eccentricity / total))
            .sum();
        let length = mean.norm().clamp(1e-6, 1.0 - 1e-9);
        let grid_rad = std::f64::consts::TAU / HEADS as f64 / 12.0_f64.sqrt();
        let sigma_rad = (-2.0 * length.ln()).sqrt().hypot(grid_rad);
        Some(Measured {
            value: mean.x.atan2(mean.y).to_degrees().rem_euclid(360.0),
            sigma: sigma_rad.to_degrees().hypot(DIRECTION_DEG),
        })
    }

    fn told(&self, standing: &Standing, width_m: Measured, height_m: Measured) -> Extent {
        let best = self.best();
        let anchor = standing.foot.xy();
        let spread = self.spread(standing);
        let corner = |k: usize| best.corner(std::f64::consts::TAU * k as f64 / CORNERS as f64);
        let polygon_m: Vec<Vector2<f64>> = (0..CORNERS).map(|k| anchor + corner(k).0).collect();
        let runs = |k: &usize| corner(*k).1 >= 0.5 * (1.0 + best.eccentricity);
        let front = (0..CORNERS).filter(runs).map(|k| polygon_m[k]).collect();
        let edge_sigma_m = self
            .measured(
                |node| node.solved[H] * (1.0 + node.eccentricity),
                |node| {
                    let place = node.covariance[(0, 0)].max(node.covariance[(1, 1)]);
                    node.covariance[(H, H)] + place
                },
            )
            .sigma
            .hypot(width_m.value / 2.0 * standing.range_share.hypot(BOX_SIGMA));
        let area = self.measured(Node::area_m2, Node::area_variance);
        Extent {
            area_m2: area.or_share(2.0 * standing.range_share.hypot(BOX_SIGMA)),
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
        prior: &SVector<f64, UNKNOWNS>,
        head: Vector2<f64>,
        eccentricity: f64,
    ) -> Option<Self> {
        let mut information = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_diagonal(prior);
        let mut right = SVector::<f64, UNKNOWNS>::zeros();
        let mut squares = 0.0;
        for row in rows {
            let by = row.by(&head, eccentricity);
            information.ger(row.weight, &by, &by, 1.0);
            right.axpy(row.reach.metres * row.weight, &by, 1.0);
            squares += row.reach.metres * row.reach.metres * row.weight;
        }
        let cholesky = information.cholesky()?;
        let solved = cholesky.solve(&right);
        let log_determinant: f64 = cholesky.l().diagonal().iter().map(|d| 2.0 * d.ln()).sum();
        let misfit = squares - solved.dot(&right);
        // As likely in each octave of size and speed, or a node that hardly says how large the fire
        // is would win by saying little.
        let octaves = (solved[H] * (1.0 + eccentricity)).ln()
            + (solved[A] * (1.0 + eccentricity)).hypot(STANDING_M_S).ln();
        (solved[H] > 0.0).then(|| Self {
            head,
            eccentricity,
            solved,
            covariance: cholesky.inverse(),
            weight: -0.5 * (misfit + log_determinant) - octaves,
        })
    }

    fn oval(&self, outwards: &Vector2<f64>) -> f64 {
        oval(&self.head, self.eccentricity, outwards)
    }

    fn front(&self, row: &Row) -> f64 {
        self.solved.dot(&row.by(&self.head, self.eccentricity))
    }

    fn area_m2(&self) -> f64 {
        let e = self.eccentricity;
        std::f64::consts::PI * self.solved[H].powi(2) * (1.0 - e * e).sqrt()
    }

    fn area_variance(&self) -> f64 {
        let by_size = 2.0 * self.area_m2() / self.solved[H];
        by_size * by_size * self.covariance[(H, H)]
    }

    /// A corner of the oval from the anchor, and how fast the front runs there against A.
    fn corner(&self, angle: f64) -> (Vector2<f64>, f64) {
        let e = self.eccentricity;
        let left = Vector2::new(-self.head.y, self.head.x);
        let (wide, size) = ((1.0 - e * e).sqrt(), self.solved[H]);
        let (x, y) = (e + angle.cos(), wide * angle.sin());
        let outwards = (self.head * (wide * angle.cos()) + left * angle.sin()).normalize();
        let place = Vector2::new(self.solved[0], self.solved[1]);
        (
            place + (self.head * x + left * y) * size,
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
