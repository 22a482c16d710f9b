//! How a fire lies on the ground and how its front runs: one burning body that every look's box
//! touches.
//!
//! **In:** the planes in which the sides and the lower edges of many boxes lie, what the cameras'
//! places and turns may be wrong by, the wind if it is known. **Out:** a [`Shape`]: nodes of a grid,
//! each a possible oval with its place, size and speed, and how likely it is.
//!
//! **How.** The side of a box is a plane through the camera that touches what burns. With `n` its
//! outward normal and `c` the camera, `n . c` is the body's support function at `n`, in perspective
//! and from any side, without an assumption of where in depth the side is. The body is an oval of
//! burning ground, widened by the flames that stand on its rim. The oval keeps its shape while it
//! grows about the place of ignition (the usual shape of fire-spread models): its head is `H + V t`
//! away, its back a share of that, its half width another. Both shares lie about those of Alexander
//! (1985), where length over width gives the ratio of head to back; flanks may be narrower or wider.
//! For each direction of the head and each pair of shares all else is linear and solved by weighted
//! least squares; nodes are weighed by their evidence.
//!
//! What moves all planes of a flight alike is not noise: heading, tilt and roll of the camera, the
//! scale of a detector's boxes, the range, the lean of the flames. Each is a disturbance with a prior.
//! So is the walk of the reported camera between looks, with the covariance of a random walk, and a
//! flame's edge, which stays alike for some seconds. All of it is in the covariance of the planes, once
//! for all nodes.

use super::extent::{Measured, Standing, Wind};
use super::outline::Look;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, SMatrix, SVector, Vector2, Vector3};

/// What is solved for at each node: place of ignition from the foot (east, north), distance of the
/// head now, its speed, scale of the flames, its growth, what their half width differs by.
const UNKNOWNS: usize = 7;
const H: usize = 2;
const V: usize = 3;
const FLAME: usize = 4;
const WIDER: usize = 6;
type Unknowns = SVector<f64, UNKNOWNS>;

/// Height, tilt and the like: what disturbs all looks alike. Heading, tilt, roll, scale of the boxes,
/// range, near rim, lean (east, north).
const DISTURBANCES: usize = 8;

/// Half width of the flames on the rim against their height; at the near rim their feet are seen.
const HALF_WIDTH: f64 = 0.3;
const FOOT_SHARE: f64 = 0.6;
/// One sigma of what that differs by, and of the near rim's, against the flames' height.
const HALF_WIDTH_SIGMA: f64 = 0.25;
const NEAR_SIGMA: f64 = 0.12;
/// Height of the flames against the box's, which holds depth too, and its sigma as a share.
const BOX_FLAME: f64 = 0.4;
const FLAME_SIGMA: f64 = 0.5;
/// One sigma of its growth per second, and of the lean, against it.
const GROWTH: f64 = 0.02;
const LEAN: f64 = 0.3;
/// One sigma of a detector's scale for a flight; what it may be beyond that is in the speed's own share.
const BOX_SCALE: f64 = 0.03;
/// What differs from look to look: share of the flame's height and of the fire's width.
const LICK: f64 = 0.06;
const JITTER: f64 = 0.01;
/// What stays alike for [`ALIKE_S`]: share of the flame's height.
const SLOW: f64 = 0.06;
const ALIKE_S: f64 = 5.0;
/// Range in which the looks' own scatter may change the weight of a look.
const WORTH: (f64, f64) = (0.1, 20.0);
/// Prior of the speed, m/s.
const SPEED_PRIOR: f64 = 3.0;

/// Directions of the head.
const HEADS: usize = 24;
/// Length over width of the oval, and how likely it is beforehand: fires before a wind of some m/s
/// are one and a half to two and a half times as long as wide.
const LENGTHS: [(f64, f64); 6] = [
    (1.1, 0.5),
    (1.25, 1.0),
    (1.5, 2.0),
    (2.0, 2.0),
    (2.7, 1.0),
    (3.5, 0.5),
];
/// Flanks against Alexander's, and how likely that is.
const FLANKS: [(f64, f64); 3] = [(0.7, 0.25), (1.0, 0.5), (1.4, 0.25)];
/// How likely a round fire is beforehand.
const ROUND: f64 = 2.0;

/// Which edge of a box.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Edge {
    Side,
    OtherSide,
    Near,
    /// The tracker's own place of the near rim: not of a box.
    Foot,
}

/// One plane that touches the fire, relative to the foot.
#[derive(Debug, Clone, Copy)]
struct Row {
    t_s: f64,
    edge: Edge,
    normal: Vector3<f64>,
    /// Horizontal part of the normal: its length and direction.
    flat: f64,
    outwards: Vector2<f64>,
    /// Support of the body that the plane says, metres.
    metres: f64,
    to_fire: Vector3<f64>,
    half_width_m: f64,
    edge_m: f64,
}

/// An oval whose head is 1 away from the place of ignition.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Oval {
    head: Vector2<f64>,
    back: f64,
    flank: f64,
}

impl Oval {
    const ROUND: Self = Self {
        head: Vector2::new(0.0, 1.0),
        back: 1.0,
        flank: 1.0,
    };

    /// Alexander's, of a length over width, with flanks of a share of his.
    fn of(head: Vector2<f64>, length: f64, flanks: f64) -> Self {
        let root = (length * length - 1.0).max(0.0).sqrt();
        let back = (length - root) / (length + root);
        Self {
            head,
            back,
            flank: flanks * (1.0 + back) / 2.0 / length,
        }
    }

    /// Support function.
    fn reach(&self, outwards: &Vector2<f64>) -> f64 {
        let (along, across) = (self.head.dot(outwards), self.head.perp(outwards));
        let half = (1.0 + self.back) / 2.0;
        (1.0 - self.back) / 2.0 * along + (half * along).hypot(self.flank * across)
    }

    /// A point of the rim and its outward direction.
    fn rim(&self, angle: f64) -> (Vector2<f64>, Vector2<f64>) {
        let left = Vector2::new(-self.head.y, self.head.x);
        let (half, middle) = ((1.0 + self.back) / 2.0, (1.0 - self.back) / 2.0);
        let (sin, cos) = angle.sin_cos();
        let place = self.head * (middle + half * cos) + left * (self.flank * sin);
        let outwards = self.head * (self.flank * cos) + left * (half * sin);
        (place, outwards.normalize())
    }

    /// How much it points: 0 for a round fire, towards 1 for one that runs one way.
    fn points(&self) -> f64 {
        (1.0 - self.back) / (1.0 + self.back)
    }
}

/// One node of the grid: an oval, and what follows for it.
#[derive(Debug, Clone, Copy)]
struct Node {
    oval: Oval,
    solved: Unknowns,
    covariance: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    weight: f64,
}

/// What the looks say about the oval.
#[derive(Debug, Clone)]
pub(super) struct Shape {
    nodes: Vec<Node>,
    used_wind: bool,
}

/// What the rows are wrong by, factored; and the columns that all nodes share, whitened.
struct Doubt {
    cholesky: Cholesky<f64, Dyn>,
    seen: DVector<f64>,
    shared: DMatrix<f64>,
    prior: Unknowns,
    prior_mean: Unknowns,
}

/// The looks as rows, and the scales that doubts go with.
struct Scene<'a> {
    rows: Vec<Row>,
    standing: &'a Standing,
    /// From the latest camera to the foot.
    sight: Vector3<f64>,
    flame_m: f64,
}

impl<'a> Scene<'a> {
    fn new(looks: &[(f64, &Look)], standing: &'a Standing) -> Option<Self> {
        let (_, last) = looks.last()?;
        let sight = standing.foot - last.camera();
        let mut heights: Vec<f64> = looks
            .iter()
            .map(|(_, look)| look.box_height_m(&standing.foot))
            .collect();
        heights.sort_by(f64::total_cmp);
        let mut rows: Vec<Row> = looks
            .iter()
            .flat_map(|(t_s, look)| rows_of(*t_s, look, &standing.foot))
            .collect();
        rows.push(foot_row(&sight)?);
        Some(Self {
            rows,
            standing,
            sight,
            flame_m: (BOX_FLAME * heights.get(heights.len() / 2)?).max(0.02),
        })
    }

    /// What a unit of each disturbance does to a row, times its sigma.
    fn disturbed(&self, row: &Row) -> SVector<f64, DISTURBANCES> {
        let (heading, tilt) = self.standing.turn_rad;
        let flat_m = self.sight.xy().norm();
        if row.edge == Edge::Foot {
            let range = -flat_m * self.standing.range_share;
            let near = NEAR_SIGMA * self.flame_m;
            return SVector::from([0.0, 0.0, 0.0, 0.0, range, near, 0.0, 0.0]);
        }
        let ahead = row.to_fire.xy().normalize();
        let ahead = Vector3::new(ahead.x, ahead.y, 0.0);
        let right = ahead.cross(&Vector3::z());
        let turned = |axis: Vector3<f64>| axis.cross(&row.normal).dot(&row.to_fire);
        let near = f64::from(u8::from(row.edge == Edge::Near));
        let lean = LEAN * self.flame_m * 0.5 * (1.0 - near);
        SVector::from([
            heading * turned(Vector3::z()),
            tilt * turned(right),
            tilt * turned(ahead),
            BOX_SCALE * row.half_width_m * (1.0 - near),
            -self.standing.range_share * row.normal.z * self.sight.z,
            NEAR_SIGMA * self.flame_m * near * row.flat,
            lean * row.normal.x,
            lean * row.normal.y,
        ])
    }

    /// Covariance of two rows, without what is each one's own.
    fn covariance(&self, a: &Row, b: &Row) -> f64 {
        if a.edge == Edge::Foot || b.edge == Edge::Foot {
            return 0.0;
        }
        let (across, up) = self.standing.wander_m;
        let flat = a.normal.xy().dot(&b.normal.xy()) * across * across;
        let walked = a.t_s.abs().min(b.t_s.abs()) * (flat + a.normal.z * b.normal.z * up * up);
        let slow = (SLOW * self.flame_m).powi(2);
        let alike = (-(a.t_s - b.t_s).abs() / ALIKE_S).exp() * slow;
        walked + if a.edge == b.edge { alike } else { 0.0 }
    }

    /// Variance of what differs from look to look.
    fn own(&self, row: &Row, worth: f64) -> f64 {
        if row.edge == Edge::Foot {
            return (0.1 * self.flame_m + 0.05).powi(2);
        }
        let jitter = 2.0 * JITTER * row.half_width_m;
        let lick = LICK * self.flame_m;
        (row.edge_m.powi(2) + lick.powi(2) + jitter.powi(2)) / worth
    }

    fn doubt(&self, worth: f64) -> Option<Doubt> {
        let n = self.rows.len();
        let by: Vec<SVector<f64, DISTURBANCES>> =
            self.rows.iter().map(|row| self.disturbed(row)).collect();
        let covariance = DMatrix::from_fn(n, n, |i, j| {
            let (a, b) = (&self.rows[i], &self.rows[j]);
            let own = if i == j { self.own(a, worth) } else { 0.0 };
            by[i].dot(&by[j]) + self.covariance(a, b) + own
        });
        let cholesky = Cholesky::new(covariance)?;
        let lower = cholesky.l();
        let seen = DVector::from_iterator(n, self.rows.iter().map(|row| row.metres));
        let columns: Vec<[f64; 5]> = self.rows.iter().map(shared_columns).collect();
        let shared = DMatrix::from_fn(n, 5, |i, k| columns[i][k]);
        let (flame, range_m) = (self.flame_m, self.sight.norm());
        let sigmas = [
            range_m,
            range_m,
            range_m,
            SPEED_PRIOR,
            FLAME_SIGMA * flame,
            GROWTH * flame,
            HALF_WIDTH_SIGMA * flame,
        ];
        let mut prior_mean = Unknowns::zeros();
        prior_mean[FLAME] = flame;
        Some(Doubt {
            seen: lower.solve_lower_triangular(&seen)?,
            shared: lower.solve_lower_triangular(&shared)?,
            cholesky,
            prior: SVector::from(sigmas.map(|sigma: f64| sigma.powi(-2))),
            prior_mean,
        })
    }

    fn nodes(&self, worth: f64, wind: Option<&Wind>) -> Option<Vec<(f64, Node)>> {
        let doubt = self.doubt(worth)?;
        let grid = grid();
        // Two columns a node: over H and over V.
        let n = self.rows.len();
        let mut columns = DMatrix::zeros(n, 2 * grid.len());
        for (k, (oval, _)) in grid.iter().enumerate() {
            for (i, row) in self.rows.iter().enumerate() {
                let reach = row.flat * oval.reach(&row.outwards);
                columns[(i, 2 * k)] = reach;
                columns[(i, 2 * k + 1)] = reach * row.t_s;
            }
        }
        let own = doubt.cholesky.l().solve_lower_triangular(&columns)?;
        let mut nodes = Vec::with_capacity(grid.len());
        for (k, (oval, likely)) in grid.iter().enumerate() {
            let solved = doubt.solve(&own.columns(2 * k, 2).into_owned(), *oval);
            nodes.extend(solved.map(|(misfit, mut node)| {
                node.weight += likely.ln() + downwind(oval, wind);
                (misfit, node)
            }));
        }
        Some(nodes)
    }
}

impl Doubt {
    /// Misfit and node for one oval, whose two columns are given whitened.
    fn solve(&self, own: &DMatrix<f64>, oval: Oval) -> Option<(f64, Node)> {
        let column = |k: usize| match k {
            H => own.column(0),
            V => own.column(1),
            0 | 1 => self.shared.column(k),
            _ => self.shared.column(k - 2),
        };
        let mut information = SMatrix::from_diagonal(&self.prior);
        let mut right = self.prior.component_mul(&self.prior_mean);
        for i in 0..UNKNOWNS {
            right[i] += column(i).dot(&self.seen);
            for j in 0..=i {
                let product = column(i).dot(&column(j));
                information[(i, j)] += product;
                if i != j {
                    information[(j, i)] += product;
                }
            }
        }
        let cholesky = information.cholesky()?;
        let solved: Unknowns = cholesky.solve(&right);
        let log_determinant: f64 = cholesky.l().diagonal().iter().map(|d| 2.0 * d.ln()).sum();
        let expected = self
            .prior
            .dot(&self.prior_mean.component_mul(&self.prior_mean));
        let misfit = self.seen.norm_squared() + expected - solved.dot(&right);
        let backwards = solved[H] < 0.0 && oval.back < 1.0;
        (!backwards).then(|| {
            let node = Node {
                oval,
                solved,
                covariance: cholesky.inverse(),
                weight: -0.5 * (misfit + log_determinant),
            };
            (misfit, node)
        })
    }
}

/// The planes of one look that say something of the ground.
fn rows_of(t_s: f64, look: &Look, foot: &Vector3<f64>) -> Vec<Row> {
    let to_fire = foot - look.camera();
    let half_width_m = look.half_width_m(foot);
    let row = |edge: Edge, normal: Vector3<f64>| {
        let flat = normal.xy().norm();
        // Straight down, the near edge is no edge on the ground.
        (flat > 0.2 && to_fire.xy().norm() > 0.5).then(|| Row {
            t_s,
            edge,
            normal,
            flat,
            outwards: normal.xy() / flat,
            metres: -normal.dot(&to_fire),
            to_fire,
            half_width_m,
            edge_m: to_fire.norm() * look.edge_rad,
        })
    };
    let [left, right, near] = look.planes();
    let rows = [
        row(Edge::Side, left),
        row(Edge::OtherSide, right),
        row(Edge::Near, near),
    ];
    rows.into_iter().flatten().collect()
}

/// The near rim as the tracker has it.
fn foot_row(sight: &Vector3<f64>) -> Option<Row> {
    let towards = -sight.xy().try_normalize(1e-3)?;
    Some(Row {
        t_s: 0.0,
        edge: Edge::Foot,
        normal: Vector3::new(towards.x, towards.y, 0.0),
        flat: 1.0,
        outwards: towards,
        metres: 0.0,
        to_fire: *sight,
        half_width_m: 0.0,
        edge_m: 0.0,
    })
}

/// A row over place, flames, their growth and their half width.
fn shared_columns(row: &Row) -> [f64; 5] {
    let flame = match row.edge {
        Edge::Side | Edge::OtherSide => 0.5 * row.normal.z + HALF_WIDTH * row.flat,
        Edge::Near | Edge::Foot => FOOT_SHARE * HALF_WIDTH * row.flat,
    };
    [row.normal.x, row.normal.y, flame, flame * row.t_s, row.flat]
}

/// All ovals, and how likely each is beforehand.
fn grid() -> Vec<(Oval, f64)> {
    let mut grid = vec![(Oval::ROUND, ROUND * HEADS as f64)];
    for k in 0..HEADS {
        let azimuth = std::f64::consts::TAU * k as f64 / HEADS as f64;
        let head = Vector2::new(azimuth.sin(), azimuth.cos());
        for (length, likely) in LENGTHS {
            grid.extend(
                FLANKS.map(|(flanks, share)| (Oval::of(head, length, flanks), likely * share)),
            );
        }
    }
    grid
}

/// Log of the prior: fires run before the wind, the surer the stronger it blows.
fn downwind(oval: &Oval, wind: Option<&Wind>) -> f64 {
    let Some(wind) = wind else {
        return 0.0;
    };
    let speed = wind.towards_m_s.norm();
    if speed < 1e-6 {
        return 0.0;
    }
    let doubt = (wind.sigma_m_s / speed).hypot(0.6);
    let (along, across) = (
        oval.head.dot(&wind.towards_m_s),
        oval.head.perp(&wind.towards_m_s),
    );
    // A round fire has no head.
    -0.5 * (across.atan2(along) / doubt).powi(2) * (1.0 - oval.back).max(0.0).sqrt()
}

/// The same with weights that sum to 1; nodes that don't matter are left out.
fn weighed(nodes: Vec<(f64, Node)>) -> Vec<Node> {
    let best = nodes
        .iter()
        .map(|(_, node)| node.weight)
        .fold(f64::MIN, f64::max);
    let weights: Vec<f64> = nodes
        .iter()
        .map(|(_, node)| (node.weight - best).exp())
        .collect();
    let total: f64 = weights.iter().sum();
    let nodes = nodes
        .into_iter()
        .zip(weights)
        .map(|((_, node), weight)| Node {
            weight: weight / total,
            ..node
        });
    nodes.filter(|node| node.weight > 1e-6).collect()
}

impl Shape {
    /// The oval that the looks (seconds before now, in time order) show; `None` for too few.
    pub(super) fn fit(
        looks: &[(f64, &Look)],
        standing: &Standing,
        wind: Option<&Wind>,
    ) -> Option<Self> {
        let scene = Scene::new(looks, standing)?;
        let first = scene.nodes(1.0, wind)?;
        let best = first
            .iter()
            .max_by(|a, b| a.1.weight.total_cmp(&b.1.weight))?;
        // The looks' own scatter about the best oval says how much each of them is worth.
        let freedom = (scene.rows.len() as f64 - UNKNOWNS as f64).max(1.0);
        let worth = (freedom / best.0.max(1e-9)).clamp(WORTH.0, WORTH.1);
        let nodes = weighed(scene.nodes(worth, wind)?);
        (!nodes.is_empty()).then_some(Self {
            nodes,
            used_wind: wind.is_some(),
        })
    }

    /// A fire that was seen from one side: a disc of a radius about a place from the foot.
    pub(super) fn disc(centre: Vector2<f64>, centre_sigma_m: f64, radius: &Measured) -> Self {
        let mut solved = Unknowns::zeros();
        (solved[0], solved[1], solved[WIDER]) = (centre.x, centre.y, radius.value);
        let mut covariance = SMatrix::zeros();
        for (unknown, sigma) in [
            (0, centre_sigma_m),
            (1, centre_sigma_m),
            (WIDER, radius.sigma),
        ] {
            covariance[(unknown, unknown)] = sigma * sigma;
        }
        Self {
            nodes: vec![Node {
                oval: Oval::ROUND,
                solved,
                covariance,
                weight: 1.0,
            }],
            used_wind: false,
        }
    }

    /// Whether the wind's direction went into it.
    pub(super) fn used_wind(&self) -> bool {
        self.used_wind
    }

    fn best(&self) -> &Node {
        let heavier = |a: &&Node, b: &&Node| a.weight.total_cmp(&b.weight);
        // There is always one: `fit` and `disc` see to it.
        self.nodes.iter().max_by(heavier).unwrap_or(&self.nodes[0])
    }

    fn mean(&self, of: impl Fn(&Node) -> f64) -> f64 {
        self.nodes.iter().map(|node| node.weight * of(node)).sum()
    }

    /// Mean over the nodes of what is linear in the unknowns, with the variance between nodes and
    /// within each.
    fn measured(&self, by: impl Fn(&Node) -> Unknowns) -> Measured {
        let value = self.mean(|node| by(node).dot(&node.solved));
        let variance = self.mean(|node| {
            let by = by(node);
            (by.dot(&node.solved) - value).powi(2) + (node.covariance * by).dot(&by)
        });
        Measured {
            value,
            sigma: variance.max(0.0).sqrt(),
        }
    }

    /// From the near edge to the far one along a line of sight.
    pub(super) fn depth_m(&self, sight: &Vector2<f64>) -> Measured {
        self.measured(|node| {
            let mut by = Unknowns::zeros();
            by[H] = node.oval.reach(sight) + node.oval.reach(&-sight);
            (by[FLAME], by[WIDER]) = (2.0 * HALF_WIDTH, 2.0);
            by
        })
    }

    /// Of the head.
    pub(super) fn speed_m_s(&self) -> Measured {
        self.measured(|_| {
            let mut by = Unknowns::zeros();
            by[V] = 1.0;
            by
        })
    }

    /// Of the edge where the head is, without the error of the fire's position.
    pub(super) fn edge_sigma_m(&self) -> f64 {
        let place = |node: &Node| {
            let mut by = Unknowns::zeros();
            (by[0], by[1], by[H]) = (node.oval.head.x, node.oval.head.y, 1.0);
            (by[FLAME], by[WIDER]) = (HALF_WIDTH, 1.0);
            by
        };
        self.measured(place).sigma
    }

    /// Circular mean and deviation of the head, each node by how much it points; `None` for what
    /// points nowhere.
    pub(super) fn azimuth_deg(&self) -> Option<Measured> {
        let total = self.mean(|node| node.oval.points());
        if total <= 1e-9 {
            return None;
        }
        let pulled = self.nodes.iter();
        let mean: Vector2<f64> = pulled
            .map(|node| node.oval.head * (node.weight * node.oval.points() / total))
            .sum();
        let length = mean.norm().clamp(1e-6, 1.0 - 1e-9);
        let grid_rad = std::f64::consts::TAU / HEADS as f64 / 12.0_f64.sqrt();
        Some(Measured {
            value: mean.x.atan2(mean.y).to_degrees().rem_euclid(360.0),
            sigma: (-2.0 * length.ln()).sqrt().hypot(grid_rad).to_degrees(),
        })
    }

    /// Corners of the burning ground from the foot, anticlockwise, each with its speed against the
    /// head's.
    pub(super) fn corners(&self, count: usize) -> Vec<(Vector2<f64>, f64)> {
        let best = self.best();
        let flames = HALF_WIDTH * best.solved[FLAME] + best.solved[WIDER];
        let place = best.solved.xy();
        let corner = |k: usize| {
            let (rim, outwards) = best
                .oval
                .rim(std::f64::consts::TAU * k as f64 / count as f64);
            let at = place + rim * best.solved[H].max(0.0) + outwards * flames.max(0.0);
            (at, best.oval.reach(&outwards))
        };
        (0..count).map(corner).collect()
    }

    /// One sigma of the burning ground's area, as a share: twice that of its mean radius.
    pub(super) fn area_share(&self) -> f64 {
        let radius = self.measured(|node| {
            let mut by = Unknowns::zeros();
            by[H] = ((1.0 + node.oval.back) / 2.0 * node.oval.flank).sqrt();
            (by[FLAME], by[WIDER]) = (HALF_WIDTH, 1.0);
            by
        });
        2.0 * radius.sigma / radius.value.abs().max(1e-3)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_frames::{ServiceTime, seconds};

    const FLAME_M: f64 = 1.5;

    /// Support of the true body over the ground, from its place of ignition.
    fn support(oval: &Oval, head_m: f64, outwards: &Vector2<f64>) -> f64 {
        head_m * oval.reach(outwards) + HALF_WIDTH * FLAME_M
    }

    /// A look from a camera at a body whose ignition is the origin: upright planes that touch its
    /// sides, found by halving, and one that touches its near rim.
    fn look(t_s: f64, camera: Vector3<f64>, oval: &Oval, head_m: f64) -> Look {
        let ahead = -camera.xy().normalize();
        let right = Vector2::new(ahead.y, -ahead.x);
        let touching = |side: Vector2<f64>| {
            let normal = |turn: f64| (side * turn.cos() - ahead * turn.sin()).normalize();
            // Leaning back far enough, the plane passes the body on the far side of the camera.
            let passes = |turn: f64| {
                let n = normal(turn);
                n.dot(&camera.xy()) > support(oval, head_m, &n)
            };
            let (mut low, mut high) = (-1.2, 1.2);
            for _ in 0..60 {
                let middle = (low + high) / 2.0;
                if passes(middle) {
                    high = middle;
                } else {
                    low = middle;
                }
            }
            let n = normal(high);
            Vector3::new(n.x, n.y, 0.0)
        };
        let near = -ahead * support(oval, head_m, &-ahead);
        let to_near = Vector3::new(near.x, near.y, 0.0) - camera;
        let lower = to_near.cross(&Vector3::new(right.x, right.y, 0.0));
        let lower = if lower.z > 0.0 { -lower } else { lower };
        let ray =
            |flat: Vector2<f64>, up: f64| (Vector3::new(flat.x, flat.y, up) - camera).normalize();
        let half = support(oval, head_m, &right);
        let rays = [
            ray(-right * half, 1.0),
            ray(right * half, 1.0),
            to_near.normalize(),
            ray(near, 3.0),
        ];
        let planes = [touching(-right), touching(right), lower.normalize()];
        let at = ServiceTime::from_unix_ns(0) + seconds(t_s);
        Look::by_planes(at, camera, planes, rays)
    }

    /// 42 s on a circle about a fire whose head runs at a speed, the last with its foot.
    fn flight(oval: &Oval, speed_m_s: f64) -> (Vec<(f64, Look)>, Standing) {
        let looks: Vec<(f64, Look)> = (0..=60)
            .map(|k| {
                let t_s = f64::from(k) * 0.7 - 42.0;
                let (sin, cos) = (0.08 * t_s).sin_cos();
                let camera = Vector3::new(40.0 * sin, 40.0 * cos, 25.0);
                (t_s, look(t_s + 100.0, camera, oval, 15.0 + speed_m_s * t_s))
            })
            .collect();
        let near = Vector2::y() * support(oval, 15.0, &Vector2::y());
        let standing = Standing {
            foot: Vector3::new(near.x, near.y, 0.0),
            range_share: 0.05,
            wander_m: (0.05, 0.05),
            turn_rad: (0.02, 0.007),
        };
        (looks, standing)
    }

    fn fitted(oval: &Oval, speed_m_s: f64) -> Shape {
        let (looks, standing) = flight(oval, speed_m_s);
        let looks: Vec<(f64, &Look)> = looks.iter().map(|(t_s, look)| (*t_s, look)).collect();
        Shape::fit(&looks, &standing, None).unwrap()
    }

    #[test]
    fn a_front_that_runs_is_found_with_its_speed_direction_and_depth() {
        let azimuth = 70_f64.to_radians();
        let oval = Oval::of(Vector2::new(azimuth.sin(), azimuth.cos()), 1.7, 1.1);
        let shape = fitted(&oval, 0.3);
        let (speed, head) = (shape.speed_m_s(), shape.azimuth_deg().unwrap());
        assert!((speed.value / 0.3 - 1.0).abs() < 0.12, "{speed:?}");
        assert!(
            (speed.value - 0.3).abs() < 2.5 * speed.sigma + 0.02,
            "{speed:?}"
        );
        assert!((head.value - 70.0).abs() < 8.0, "{head:?}");
        let depth = shape.depth_m(&Vector2::y());
        let truth = support(&oval, 15.0, &Vector2::y()) + support(&oval, 15.0, &-Vector2::y());
        assert!((depth.value / truth - 1.0).abs() < 0.1, "{depth:?} {truth}");
    }

    #[test]
    fn a_fire_that_stands_is_slow_and_one_that_grows_all_around_points_nowhere() {
        let oval = Oval::of(Vector2::x(), 1.7, 1.0);
        let speed = fitted(&oval, 0.0).speed_m_s();
        assert!(speed.value.abs() < 0.03, "{speed:?}");
        let round = fitted(&Oval::ROUND, 0.2);
        let head = round.azimuth_deg();
        assert!(head.is_none_or(|head| head.sigma > 20.0), "{head:?}");
    }

    #[test]
    fn corners_lie_on_the_oval_and_the_head_is_the_fastest() {
        let oval = Oval::of(Vector2::x(), 1.5, 1.0);
        for k in 0..24 {
            let (rim, outwards) = oval.rim(f64::from(k) * 0.26);
            assert!((rim.dot(&outwards) - oval.reach(&outwards)).abs() < 1e-9);
            assert!(oval.reach(&outwards) <= 1.0 + 1e-9);
        }
        assert!((oval.reach(&Vector2::x()) - 1.0).abs() < 1e-9);
        assert!((oval.reach(&-Vector2::x()) - oval.back).abs() < 1e-9);
    }
}
