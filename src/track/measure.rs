//! A sighting as a linearised measurement of one fire: bearing, disparity, and the ground it stands on.

use super::block::{
    Block, ByState, Chart, INVERSE_DEPTH, MEASURED, Measurement, PER_FIRE, State, TERRAIN,
};
use super::common::Common;
use crate::locate::{Distant, Lens, Linear, Sighting, Terrain, View, range_beneath};
use emberfix_frames::{Coordinate, Metres, MissionEnu, Vector3, Wgs84Parts};
use nalgebra::{Matrix2, SymmetricEigen};

/// Rows of a [`Measurement`].
const DISPARITY: usize = 2;
const GROUND: usize = 3;

/// How well a position can be held to the terrain model plus its offset, metres.
const GROUND_NOISE_M: f64 = 0.1;
/// Planes that differ by less are the same ground, metres.
const SAME_GROUND_M: f64 = 0.3;
/// Least step of the terrain's numeric slope, metres.
const SLOPE_STEP_M: f64 = 2.0;
/// Longest step of the terrain's numeric slope over the height above it.
const SLOPE_REACH: f64 = 10.0;
/// Passes of the search for the fire's most likely state.
const PASSES: usize = 8;
/// Steps larger than this, in units of the state's own sigmas, begin the search; smaller ones end it.
const LARGE_STEP: f64 = 0.7;
const SMALL_STEP: f64 = 0.01;

/// The ground about a fire, as a plane: what its height is at a place, how it slopes, and how far
/// the real one strays from that within the fire's own error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalGround {
    at: Vector3<f64>,
    /// Of the ground above `at`, metres.
    height_m: f64,
    slope: (f64, f64),
    stray_m: f64,
}

/// What measures one fire in one frame.
#[derive(Clone, Copy)]
pub struct Look<'a> {
    /// The sighting.
    pub sighting: &'a Sighting,
    /// The camera, as far as it is known.
    pub lens: &'a Lens,
    /// Local vertical.
    pub up: Vector3<f64>,
    /// The ground, when its time has come.
    pub ground: Option<LocalGround>,
    /// Share of the way since the first sighting that was surely flown.
    pub flown_share: f64,
}

impl Look<'_> {
    /// Linearised at `from`, the common errors being at their mean, and the state that this was at.
    /// When the sighting moves the fire by much of its own sigmas, it is linearised where the fire then
    /// most likely is; but not otherwise, since slopes that follow each sighting's own noise are
    /// not independent of it.
    #[must_use]
    pub fn measure(
        &self,
        block: &Block,
        common: &Common,
        from: State,
    ) -> Option<(Measurement, State)> {
        let prior = block.state(common);
        let mut at = from;
        let mut m = self.linearise(block.chart(), &at)?;
        let mut limit = LARGE_STEP;
        for _ in 0..PASSES {
            let Some(step) = self.step(&m, block, &prior, &at) else {
                break;
            };
            let is_small =
                |i: usize| step[i].powi(2) <= limit * limit * block.own()[(i, i)].max(1e-18);
            if (0..PER_FIRE).all(is_small) {
                break;
            }
            let next = clamped(at + step);
            let Some(better) = self.linearise(block.chart(), &next) else {
                break;
            };
            (at, m, limit) = (next, better, SMALL_STEP);
        }
        Some((m, at))
    }

    /// Gauss-Newton step towards the most likely state.
    fn step(&self, m: &Measurement, block: &Block, prior: &State, at: &State) -> Option<State> {
        let mut spread = m.by_state * block.own() * m.by_state.transpose();
        for row in 0..MEASURED {
            spread[(row, row)] += m.noise[row];
        }
        let left = m.residual - m.by_state * (prior - at);
        let solved = spread.cholesky()?.solve(&left);
        Some(prior + block.own() * m.by_state.transpose() * solved - at)
    }

    /// Linearised at one state of the fire.
    #[must_use]
    pub fn linearise(&self, chart: &Chart, at: &State) -> Option<Measurement> {
        let (point, _, _) = chart.distant(at);
        let linear = self.lens.linear(&point)?;
        let mut m = Measurement::silent();
        let seen = self.slopes(chart, &linear, at);
        let pixel = [self.sighting.base.u, self.sighting.base.v];
        let sigma = [self.sighting.base_sigma_px.0, self.sighting.base_sigma_px.1];
        for row in 0..2 {
            m.residual[row] = pixel[row] - linear.value[row];
            m.by_state.set_row(row, &seen.row(row));
            m.by_shared.set_row(row, &linear.by_shared.row(row));
            m.noise[row] = sigma[row] * sigma[row];
        }
        self.take_disparity(&mut m, &point, chart, at);
        if let Some(ground) = &self.ground {
            take_ground(&mut m, ground, chart, at);
        }
        Some(m)
    }

    fn slopes(&self, chart: &Chart, linear: &Linear, at: &State) -> ByState {
        chart.slopes(linear, at, self.lens.centre(), self.flown_share)
    }

    /// Disparity of the flame, which was measured above the base: by how much, the pixels say.
    fn take_disparity(&self, m: &mut Measurement, base: &Distant, chart: &Chart, at: &State) {
        let Some(measured) = self.sighting.disparity else {
            return;
        };
        let Some(flame) = self.flame_above(base, measured.centroid) else {
            return;
        };
        let Some(linear) = self.lens.linear(&flame) else {
            return;
        };
        let seen = self.slopes(chart, &linear, at);
        m.residual[DISPARITY] = measured.px - linear.value[DISPARITY];
        m.by_state.set_row(DISPARITY, &seen.row(DISPARITY));
        m.by_shared
            .set_row(DISPARITY, &linear.by_shared.row(DISPARITY));
        m.noise[DISPARITY] = measured.sigma_px * measured.sigma_px;
    }

    /// The point above the base that shows at the flame's pixel.
    fn flame_above(
        &self,
        base: &Distant,
        pixel: emberfix_calib::RectifiedPixel,
    ) -> Option<Distant> {
        let ray = self.lens.ray_enu(pixel);
        let sight = base.at - self.lens.centre() * base.over;
        let range = range_beneath(&sight, &ray, &self.up)?;
        let height = (ray * range - sight).dot(&self.up);
        Some(Distant {
            at: base.at + self.up * height,
            over: base.over,
        })
    }
}

/// The base stands on the ground: up = terrain(east, north) + the fire's own terrain offset. Taken
/// times the inverse depth, in which it is nearly linear.
fn take_ground(m: &mut Measurement, ground: &LocalGround, chart: &Chart, at: &State) {
    let (point, by, over_by) = chart.distant(at);
    let normal = ground.normal().transpose();
    let beneath = normal.dot(&ground.at.transpose()) + ground.height_m + at[TERRAIN];
    m.residual[GROUND] = beneath * point.over - normal.dot(&point.at.transpose());
    let mut by_state = normal * by - over_by * beneath;
    by_state[TERRAIN] -= point.over;
    m.by_state.set_row(GROUND, &by_state);
    m.noise[GROUND] = (GROUND_NOISE_M.powi(2) + ground.stray_m.powi(2)) * point.over.powi(2);
}

/// Inverse depths stay in front of the camera.
fn clamped(mut state: State) -> State {
    state[INVERSE_DEPTH] = state[INVERSE_DEPTH].clamp(5e-4, 2.0);
    state
}

impl LocalGround {
    /// Upwards, of length one upwards.
    fn normal(&self) -> Vector3<f64> {
        Vector3::new(-self.slope.0, -self.slope.1, 1.0)
    }

    /// True when the model at `point` is where this plane puts it, to within what it strays anyway.
    #[must_use]
    pub fn holds_at(&self, point: &Vector3<f64>, view: &View<'_>, terrain: &dyn Terrain) -> bool {
        let above = self.normal().dot(&(point - self.at)) - self.height_m;
        let limit = SAME_GROUND_M + 0.5 * self.stray_m;
        height_of_ground(point, view, terrain).is_some_and(|height| (height + above).abs() < limit)
    }

    /// The ground about `point` within the horizontal error `covariance`: a plane through what the
    /// model says at the ends of the ellipse's axes, and what the model strays from that plane.
    /// `None` where the model says nothing.
    #[must_use]
    pub fn about(
        point: &Vector3<f64>,
        covariance: &Matrix2<f64>,
        view: &View<'_>,
        terrain: &dyn Terrain,
    ) -> Option<Self> {
        let middle = height_of_ground(point, view, terrain)?;
        let limit = SLOPE_REACH * (view.camera_enu.z - point.z).abs().max(SLOPE_STEP_M);
        let ellipse = SymmetricEigen::new(*covariance);
        let (mut slope, mut stray) = (nalgebra::Vector2::zeros(), 0.0_f64);
        for axis in 0..2 {
            let along = ellipse.eigenvectors.column(axis);
            let reach = (3.0 * ellipse.eigenvalues[axis].max(0.0))
                .sqrt()
                .clamp(SLOPE_STEP_M, limit);
            let at = |sign: f64| {
                let step = along * (sign * reach);
                let there = point + Vector3::new(step[0], step[1], 0.0);
                height_of_ground(&there, view, terrain)
            };
            let (Some(ahead), Some(behind)) = (at(1.0), at(-1.0)) else {
                continue;
            };
            slope += along * ((ahead - behind) / (2.0 * reach));
            // As for the clock: what a parabola strays from its line, at sqrt(3) sigma.
            stray += ((ahead + behind) * 0.5 - middle).powi(2) / 3.0;
        }
        Some(Self {
            at: *point,
            height_m: middle,
            slope: (slope[0], slope[1]),
            stray_m: stray.sqrt(),
        })
    }
}

/// Height of the terrain model above a point of the mission plane, metres.
fn height_of_ground(point: &Vector3<f64>, view: &View<'_>, terrain: &dyn Terrain) -> Option<f64> {
    let place = view.place(&Coordinate::<MissionEnu>::from_metres(*point))?;
    let ground = terrain.height_at(&place)?;
    Some(ground.m() - place.height().m())
}
