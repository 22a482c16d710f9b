//! What the looks say, as planes, and what those are wrong by.

use super::super::extent::Standing;
use super::super::outline::Look;
use nalgebra::{DMatrix, SVector, Vector2, Vector3};

/// Height, tilt and the like: what disturbs all looks alike. Heading, tilt, roll, scale of the boxes,
/// range, near rim, lean (east, north).
const DISTURBANCES: usize = 8;

/// Half width of the flames on the rim against their height; at the near rim their feet are seen.
pub(super) const HALF_WIDTH: f64 = 0.3;
const FOOT_SHARE: f64 = 0.6;
/// One sigma of what that differs by, and of the near rim's, against the flames' height.
pub(super) const HALF_WIDTH_SIGMA: f64 = 0.15;
const NEAR_SIGMA: f64 = 0.12;
/// Height of the flames against the box's, which holds depth too, and its sigma as a share.
const BOX_FLAME: f64 = 0.4;
pub(super) const FLAME_SIGMA: f64 = 0.3;
/// One sigma of its growth per second, and of the lean, against it. A front that gets longer is
/// thinner to look at: its flames seem to shrink while it runs.
pub(super) const GROWTH: f64 = 0.04;
const LEAN: f64 = 0.15;
/// One sigma of a detector's scale for a flight; what it may be beyond that is in the speed's own share.
const BOX_SCALE: f64 = 0.03;
/// What differs from look to look: share of the flame's height and of the fire's width.
const LICK: f64 = 0.06;
const JITTER: f64 = 0.01;
/// What stays alike for [`ALIKE_S`]: share of the flame's height.
const SLOW: f64 = 0.1;
const ALIKE_S: f64 = 5.0;
/// Range in which the looks' own scatter may change the weight of a look.
pub(super) const WORTH: (f64, f64) = (0.1, 20.0);

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
pub(super) struct Row {
    pub t_s: f64,
    edge: Edge,
    normal: Vector3<f64>,
    /// Horizontal part of the normal: its length and direction.
    pub flat: f64,
    pub outwards: Vector2<f64>,
    /// Support of the body that the plane says, metres.
    pub metres: f64,
    to_fire: Vector3<f64>,
    half_width_m: f64,
    edge_m: f64,
}

/// The looks as rows, and the scales that doubts go with.
pub(super) struct Scene<'a> {
    pub rows: Vec<Row>,
    standing: &'a Standing,
    /// From the latest camera to the foot.
    pub sight: Vector3<f64>,
    /// Height of the flames, roughly.
    pub flame_m: f64,
}

impl<'a> Scene<'a> {
    pub(super) fn new(looks: &[(f64, &Look)], standing: &'a Standing) -> Option<Self> {
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

    /// Covariance of all rows, when each is worth so much more than assumed.
    pub(super) fn covariance_of_rows(&self, worth: f64) -> DMatrix<f64> {
        let n = self.rows.len();
        let by: Vec<SVector<f64, DISTURBANCES>> =
            self.rows.iter().map(|row| self.disturbed(row)).collect();
        DMatrix::from_fn(n, n, |i, j| {
            let (a, b) = (&self.rows[i], &self.rows[j]);
            let own = if i == j { self.own(a, worth) } else { 0.0 };
            by[i].dot(&by[j]) + self.covariance(a, b) + own
        })
    }
}

impl Row {
    /// What a unit of place (east, north), flames, their growth and their half width does to it.
    pub(super) fn shared_columns(&self) -> [f64; 5] {
        let flame = match self.edge {
            Edge::Side | Edge::OtherSide => 0.5 * self.normal.z + HALF_WIDTH * self.flat,
            Edge::Near | Edge::Foot => FOOT_SHARE * HALF_WIDTH * self.flat,
        };
        [
            self.normal.x,
            self.normal.y,
            flame,
            flame * self.t_s,
            self.flat,
        ]
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
