//! A sighting as a linearised measurement of one fire: bearing, disparity, and the ground it stands on.

use super::block::{Block, Chart, MEASURED, Measurement, PER_FIRE, State, TERRAIN};
use super::common::Common;
use crate::locate::{Distant, Lens, Linear, Sighting, Terrain, View, range_beneath};
use emberfix_frames::{Coordinate, Metres, MissionEnu, Vector3, Wgs84Parts};
use nalgebra::{Matrix2, SMatrix, SymmetricEigen};

/// Rows of a [`Measurement`].
const DISPARITY: usize = 2;
const GROUND: usize = 3;

/// How well a position can be held to the terrain model plus its offset, metres.
const GROUND_NOISE_M: f64 = 0.1;
/// Least step of the terrain's numeric slope, metres.
const SLOPE_STEP_M: f64 = 2.0;
/// Longest step of the terrain's numeric slope over the height above it.
const SLOPE_REACH: f64 = 10.0;
/// Passes of the search for the fire's most likely state.
const PASSES: usize = 8;
/// Steps smaller than this, in units of the state's own sigmas, end the search.
const SMALL_STEP: f64 = 0.01;

/// The ground about a fire, as a plane: what its height is at a place, how it slopes, and how far
/// the real one strays from that within the fire's own error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalGround {
    at: Vector3<f64>,
    up_m: f64,
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
}

impl Look<'_> {
    /// Linearised where the fire most likely is, the common errors being at their mean: and that state.
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
        for _ in 0..PASSES {
            let Some(step) = self.step(&m, block, &prior, &at) else {
                break;
            };
            let next = clamped(at + step, block.chart());
            let Some(better) = self.linearise(block.chart(), &next) else {
                break;
            };
            let moved = next - at;
            (at, m) = (next, better);
            let small = (0..PER_FIRE)
                .all(|i| moved[i].powi(2) <= SMALL_STEP.powi(2) * block.own()[(i, i)].max(1e-18));
            if small {
                break;
            }
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
        let (point, by, over_by) = chart.distant(at);
        let linear = self.lens.linear(&point)?;
        let mut m = Measurement::silent();
        let seen = rows(&linear, &by, &over_by);
        let pixel = [self.sighting.base.u, self.sighting.base.v];
        let sigma = [self.sighting.base_sigma_px.0, self.sighting.base_sigma_px.1];
        for row in 0..2 {
            m.residual[row] = pixel[row] - linear.value[row];
            m.by_state.set_row(row, &seen.row(row));
            m.by_shared.set_row(row, &linear.by_shared.row(row));
            m.noise[row] = sigma[row] * sigma[row];
        }
        self.take_disparity(&mut m, &point, &by, &over_by);
        if let Some(ground) = &self.ground {
            take_ground(&mut m, ground, chart, at);
        }
        Some(m)
    }

    /// Disparity of the flame, which was measured above the base: by how much, the pixels say.
    fn take_disparity(
        &self,
        m: &mut Measurement,
        base: &Distant,
        by: &nalgebra::Matrix3<f64>,
        over_by: &Vector3<f64>,
    ) {
        let Some(measured) = self.sighting.disparity else {
            return;
        };
        let Some(flame) = self.flame_above(base, measured.centroid) else {
            return;
        };
        let Some(linear) = self.lens.linear(&flame) else {
            return;
        };
        let seen = rows(&linear, by, over_by);
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

/// Rows over the fire's coordinates.
fn rows(
    linear: &Linear,
    by: &nalgebra::Matrix3<f64>,
    over_by: &Vector3<f64>,
) -> SMatrix<f64, 3, PER_FIRE> {
    let mut rows = SMatrix::<f64, 3, PER_FIRE>::zeros();
    rows.fixed_columns_mut::<3>(0)
        .copy_from(&(linear.by_at * by + linear.by_over * over_by.transpose()));
    rows
}

/// The base stands on the ground: up = terrain(east, north) + the fire's own terrain offset.
fn take_ground(m: &mut Measurement, ground: &LocalGround, chart: &Chart, at: &State) {
    let here = chart.position(at);
    let (east, north) = ground.slope;
    let up = ground.up_m + east * (here.x - ground.at.x) + north * (here.y - ground.at.y);
    let normal = nalgebra::RowVector3::new(-east, -north, 1.0);
    let by_state = normal * chart.position_by_state(at);
    m.residual[GROUND] = up + at[TERRAIN] - here.z;
    m.by_state
        .fixed_view_mut::<1, 3>(GROUND, 0)
        .copy_from(&by_state);
    m.by_state[(GROUND, TERRAIN)] = -1.0;
    m.noise[GROUND] = GROUND_NOISE_M.powi(2) + ground.stray_m.powi(2);
}

/// Inverse depths stay in front of the camera.
fn clamped(mut state: State, chart: &Chart) -> State {
    if let Chart::Anchored { .. } = chart {
        state[2] = state[2].clamp(5e-4, 2.0);
    }
    state
}

impl LocalGround {
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
        let middle = ground_up(point, view, terrain)?;
        let limit = SLOPE_REACH * (view.camera_enu.z - point.z).abs().max(SLOPE_STEP_M);
        let ellipse = SymmetricEigen::new(*covariance);
        let (mut slope, mut stray) = (nalgebra::Vector2::zeros(), 0.0);
        for axis in 0..2 {
            let along = ellipse.eigenvectors.column(axis);
            let reach = (3.0 * ellipse.eigenvalues[axis].max(0.0))
                .sqrt()
                .clamp(SLOPE_STEP_M, limit);
            let at = |sign: f64| {
                let step = along * (sign * reach);
                ground_up(
                    &(point + Vector3::new(step[0], step[1], 0.0)),
                    view,
                    terrain,
                )
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
            up_m: middle,
            slope: (slope[0], slope[1]),
            stray_m: stray.sqrt(),
        })
    }
}

/// Height of the terrain model beneath a point, in the mission plane.
fn ground_up(point: &Vector3<f64>, view: &View<'_>, terrain: &dyn Terrain) -> Option<f64> {
    let place = view.place(&Coordinate::<MissionEnu>::from_metres(*point))?;
    let ground = terrain.height_at(&place)?;
    Some(point.z + ground.m() - place.height().m())
}
