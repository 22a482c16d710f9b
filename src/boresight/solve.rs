//! The batch: Gauss-Newton, damped, robust.

use super::model::{Model, N, Parameter, Parameters, Sight, Start, Stereo, mount_of, part};
use super::wander::{Prior, Unknowns};
use emberfix_frames::{MountAngles, UnitQuaternion, Vector3};
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector};

type Normal = DMatrix<f64>;
type Residual = SVector<f64, 2>;

/// Why there is no solution.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SolveError {
    /// Too little to solve from.
    #[error("the marker was seen in {sights} pictures, needed are {least} at least")]
    TooFew {
        /// Pictures.
        sights: usize,
        /// Needed.
        least: usize,
    },
    /// Most sights agree with no one marker.
    #[error(
        "{outliers} of {sights} sights agree with no fixed point: was the same marker picked in each \
         picture, is it where it was said to be, is this the rig of the flight?"
    )]
    NoAgreement {
        /// Sights that disagree.
        outliers: usize,
        /// All of them.
        sights: usize,
    },
    /// The numbers ran away.
    #[error("the solution is not finite; rays may be parallel: fly past the marker, not at it")]
    NotFinite,
}

/// What the flight showed.
#[derive(Debug, Clone)]
pub struct Solution {
    /// Every parameter, see [`Parameter`]; of what wanders, the part that stays.
    pub parameters: SVector<f64, N>,
    /// Covariance of all parameters.
    pub covariance: SMatrix<f64, N, N>,
    /// One sigma of every parameter beforehand.
    pub before: SVector<f64, N>,
    /// The mount as found.
    pub mount: MountAngles,
    /// The lever arm as found, metres.
    pub arm_m: Vector3<f64>,
    /// Sights that were used.
    pub used: usize,
    /// Sights that disagree with the rest.
    pub outliers: usize,
    /// Root mean square of what is left over per axis, pixels, of those that were used.
    pub rms_px: f64,
    /// By how much neighbours' likeness widened the covariance (variance).
    pub widened: f64,
    /// Share of the sights, in time, that turned left, and right, faster than a degree a second.
    pub turned: (f64, f64),
    /// Turn rate about all axes, root mean square, rad/s.
    pub rate_rad_s: f64,
    /// Whether the marker was surveyed.
    pub surveyed: bool,
    /// How far the marker was where stereo measured it.
    pub ranges: Ranges,
}

/// Inverse depths of the marker along the rectified boresight, by all that was seen of it but stereo.
#[derive(Debug, Clone)]
pub struct Ranges {
    /// 1/m, of each sight with [`Stereo`] that agrees with the rest.
    pub per_m: DVector<f64>,
    /// Their covariance, 1/m²: what is wrong with one is mostly wrong with all.
    pub covariance: DMatrix<f64>,
    /// What stereo said of each.
    pub stereo: Vec<Stereo>,
}

const CLOCK: usize = Parameter::Clock as usize;
/// Fewest pictures.
const LEAST: usize = 8;
/// Clock offsets from which the search starts, seconds.
const CLOCK_STARTS_S: [f64; 7] = [-0.45, -0.3, -0.15, 0.0, 0.15, 0.3, 0.45];
/// Steps of a first look, and of the final search.
const STEPS: (usize, usize) = (15, 50);
/// Cauchy's constant: 95 % as good as least squares when nothing is wrong.
const CAUCHY: f64 = 2.385;
/// Sigmas beyond which a sight disagrees.
const OUTLIER: f64 = 5.0;
/// Scale of the residuals, in sights' sigmas, beyond which this is no scatter but disagreement.
const MOST_SCALE: f64 = 8.0;
/// A step that gains less than this share has arrived.
const SETTLED: f64 = 1e-8;
/// Sights of a first look.
const FIRST_LOOK: usize = 60;
/// Share of sights that may disagree.
const MOST_OUTLIERS: f64 = 0.5;
/// Turn of the nose that counts as a turn, rad/s.
const TURNING_RAD_S: f64 = 0.0175;

impl Solution {
    /// One parameter.
    #[must_use]
    pub fn value(&self, parameter: Parameter) -> f64 {
        self.parameters[parameter as usize]
    }

    /// One sigma of a parameter.
    #[must_use]
    pub fn sigma(&self, index: usize) -> f64 {
        self.covariance[(index, index)].max(0.0).sqrt()
    }

    /// Correlation of two parameters.
    #[must_use]
    pub fn correlation(&self, a: usize, b: usize) -> f64 {
        self.covariance[(a, b)] / (self.sigma(a) * self.sigma(b)).max(1e-30)
    }

    /// One sigma of mount yaw and heading error together: where the camera points over ground.
    #[must_use]
    pub fn bearing_sigma(&self) -> f64 {
        let (yaw, heading) = (Parameter::MountYaw as usize, Parameter::Heading as usize);
        let c = &self.covariance;
        // A nose that is said to be too far right is undone by a camera that looks further right.
        (c[(yaw, yaw)] + c[(heading, heading)] - 2.0 * c[(yaw, heading)])
            .max(0.0)
            .sqrt()
    }

    /// The mount, the arm and the clock as a rig file should have them; the clock is added to the rig's.
    #[must_use]
    pub fn clock_s(&self) -> f64 {
        self.value(Parameter::Clock)
    }

    /// One sigma of the boresight, radians: the worst of its axes.
    #[must_use]
    pub fn boresight_sigma(&self) -> f64 {
        (0..3).map(|axis| self.sigma(axis)).fold(0.0, f64::max)
    }
}

/// Solves for everything.
///
/// # Errors
/// [`SolveError`].
pub fn solve(start: &Start, sights: &[Sight]) -> Result<Solution, SolveError> {
    if sights.len() < LEAST {
        return Err(SolveError::TooFew {
            sights: sights.len(),
            least: LEAST,
        });
    }
    let every = sights.len().div_ceil(FIRST_LOOK);
    let few: Vec<Sight> = sights.iter().step_by(every).cloned().collect();
    let prior = Prior::new(start, sights);
    let glance = Batch {
        start,
        sights: &few,
        prior: &prior,
    };
    let first_looks = CLOCK_STARTS_S.map(|clock| glance.search(glance.begin(clock), STEPS.0));
    let best = first_looks
        .into_iter()
        .min_by(|a, b| a.robust.total_cmp(&b.robust))
        .ok_or(SolveError::NotFinite)?;
    let batch = Batch {
        start,
        sights,
        prior: &prior,
    };
    let found = batch.search(best.x, STEPS.1);
    batch.conclude(&found)
}

struct Batch<'a> {
    start: &'a Start,
    sights: &'a [Sight],
    prior: &'a Prior,
}

/// Where a search stands.
struct Found {
    x: Unknowns,
    /// In sights' sigmas.
    residuals: Vec<Residual>,
    /// Scale of the residuals, in sights' sigmas.
    scale: f64,
    /// Median of the residuals' lengths, in sights' sigmas: compares searches, whatever their scale.
    robust: f64,
}

impl Batch<'_> {
    fn begin(&self, clock_s: f64) -> Unknowns {
        let mut x = self.prior.mean().clone();
        x[Parameter::Clock as usize] = clock_s;
        if self.start.marker_m.is_none() {
            let marker = self.meeting(clock_s);
            x.fixed_rows_mut::<3>(Parameter::Marker as usize)
                .copy_from(&marker);
        }
        x
    }

    /// The point nearest to all rays: where an unsurveyed marker may be.
    fn meeting(&self, clock_s: f64) -> Vector3<f64> {
        let (mut normal, mut sum) = (Matrix3::identity() * 1e-9, Vector3::zeros());
        let body_from_camera = self.start.body_from_camera;
        for sight in self.sights {
            let Some(body) = sight.way.at(clock_s) else {
                continue;
            };
            let ray = body.enu_from_body * (body_from_camera * self.direction(sight));
            let camera = body.position_m + body.enu_from_body * self.start.arm_m;
            let across = Matrix3::identity() - ray * ray.transpose();
            normal += across;
            sum += across * camera;
        }
        normal
            .try_inverse()
            .map_or_else(Vector3::zeros, |inverse| inverse * sum)
    }

    /// Unit vector of a raw pixel, distortion undone by fixed-point steps on the forward model.
    fn direction(&self, sight: &Sight) -> Vector3<f64> {
        let camera = &self.start.camera;
        let mut ray = Vector3::new(0.0, 0.0, 1.0);
        for _ in 0..10 {
            let seen = camera.project(&ray);
            ray.x += (sight.pixel.u - seen.u) / camera.focal_px.0;
            ray.y += (sight.pixel.v - seen.v) / camera.focal_px.1;
        }
        ray.normalize()
    }

    /// Residual of a sight in its sigmas; what cannot be seen is far off.
    fn residual(&self, sight: &Sight, moment: &Parameters) -> Residual {
        match Model::new(self.start, moment).predict(&sight.way) {
            Some(pixel) => {
                Residual::new(pixel.u - sight.pixel.u, pixel.v - sight.pixel.v) / sight.sigma_px
            }
            None => Residual::repeat(UNSEEN / sight.sigma_px),
        }
    }

    fn residuals(&self, x: &Unknowns) -> Vec<Residual> {
        let one = |sight: &Sight| self.residual(sight, &self.prior.moment(x, sight.at));
        self.sights.iter().map(one).collect()
    }

    /// Cauchy's cost at a scale, and the cost of leaving what was known beforehand; in units of the
    /// sights' sigma², whatever the scale.
    fn cost(&self, x: &Unknowns, residuals: &[Residual], scale: f64) -> f64 {
        let width = CAUCHY * scale;
        let one = |residual: &Residual| (residual.norm() / width).powi(2).ln_1p();
        let seen: f64 = residuals.iter().map(one).sum();
        seen * width * width + self.prior.distance_squared(x) * scale * scale
    }

    fn search(&self, mut x: Unknowns, steps: usize) -> Found {
        let mut residuals = self.residuals(&x);
        let mut scale = scale_of(&residuals);
        let mut cost = self.cost(&x, &residuals, scale);
        let mut damping = 1e-3;
        let mut system = self.linearise(&x, &residuals, scale);
        for _ in 0..steps {
            let (normal, gradient) = &system;
            let damped = normal + Normal::from_diagonal(&(normal.diagonal() * damping));
            let there = damped.cholesky().map(|c| &x - c.solve(gradient));
            let then = there.map(|there| {
                let residuals = self.residuals(&there);
                (self.cost(&there, &residuals, scale), there, residuals)
            });
            match then {
                Some((less, there, left)) if less < cost => {
                    let settled = cost - less < SETTLED * cost;
                    (x, residuals) = (there, left);
                    damping = (damping * 0.2).max(1e-9);
                    // The scale only shrinks: as the fit gets better, fewer sights are far off.
                    scale = scale.min(scale_of(&residuals));
                    cost = self.cost(&x, &residuals, scale);
                    system = self.linearise(&x, &residuals, scale);
                    if settled {
                        break;
                    }
                }
                _ if damping > 1e9 => break,
                _ => damping *= 5.0,
            }
        }
        Found {
            robust: median_length(&residuals),
            residuals,
            scale,
            x,
        }
    }

    /// Normal equations, weighted; what was known beforehand is in them.
    fn linearise(&self, x: &Unknowns, residuals: &[Residual], scale: f64) -> (Normal, Unknowns) {
        let prior = self.prior.information() * (scale * scale);
        let mut gradient = &prior * (x - self.prior.mean());
        let mut normal = prior;
        for (sight, residual) in self.sights.iter().zip(residuals) {
            let by = self.derivative(x, sight, residual);
            let (by, places) = self.prior.spread(&by, sight.at);
            let weight = cauchy_weight(residual.norm(), scale);
            let (square, slope) = (
                by.transpose() * by * weight,
                by.transpose() * residual * weight,
            );
            for (i, row) in places.iter().enumerate() {
                gradient[*row] += slope[i];
                for (j, column) in places.iter().enumerate() {
                    normal[(*row, *column)] += square[(i, j)];
                }
            }
        }
        (normal, gradient)
    }

    /// Of a sight's residual over the parameters at its moment, by forward differences.
    fn derivative(&self, x: &Unknowns, sight: &Sight, residual: &Residual) -> SMatrix<f64, 2, N> {
        let moment = self.prior.moment(x, sight.at);
        let mut by = SMatrix::<f64, 2, N>::zeros();
        for index in 0..N {
            let step = step_of(index);
            let mut there = moment;
            there[index] += step;
            by.set_column(index, &((self.residual(sight, &there) - residual) / step));
        }
        by
    }

    fn conclude(&self, found: &Found) -> Result<Solution, SolveError> {
        let x: Parameters = found.x.fixed_rows::<N>(0).into_owned();
        let limit = OUTLIER * found.scale.min(MOST_SCALE);
        let kept: Vec<usize> = (0..self.sights.len())
            .filter(|sight| found.residuals[*sight].norm() <= limit)
            .collect();
        let outliers = self.sights.len() - kept.len();
        if outliers as f64 > MOST_OUTLIERS * self.sights.len() as f64 || kept.len() < LEAST {
            return Err(SolveError::NoAgreement {
                outliers,
                sights: self.sights.len(),
            });
        }
        let widened = widening(kept.iter().map(|sight| found.residuals[*sight]));
        let covariance = self.covariance(found, widened);
        let covariance = covariance
            .filter(|c| c.iter().all(|value| value.is_finite()) && x.iter().all(|v| v.is_finite()))
            .ok_or(SolveError::NotFinite)?;
        Ok(Solution {
            mount: self.mount(&x),
            arm_m: self.start.arm_m + part(&x, Parameter::Arm),
            used: kept.len(),
            outliers,
            rms_px: self.rms_px(found, &kept),
            widened,
            turned: self.turned(),
            rate_rad_s: self.rate_rad_s(),
            surveyed: self.start.marker_m.is_some(),
            before: self.start.sigmas,
            parameters: x,
            ranges: self.ranges(found, &kept, &covariance),
            covariance: covariance.fixed_view::<N, N>(0, 0).into_owned(),
        })
    }

    /// Of all unknowns: what was measured, at its own scale and widened, and what was known beforehand.
    fn covariance(&self, found: &Found, widened: f64) -> Option<Normal> {
        let (normal, _) = self.linearise(&found.x, &found.residuals, found.scale);
        let prior = self.prior.information();
        let weight = found.scale * found.scale;
        let measured = (normal - prior * weight) / (weight * widened);
        // Scaled by what was known, so that radians and metres of kilometres do not spoil the inverse.
        let units = Normal::from_diagonal(self.prior.sigmas());
        let inverse = (&units * (measured + prior) * &units).cholesky()?.inverse();
        Some(&units * inverse * &units)
    }

    fn ranges(&self, found: &Found, kept: &[usize], covariance: &Normal) -> Ranges {
        let sights = || kept.iter().map(|sight| &self.sights[*sight]);
        let known: Vec<(Stereo, f64, DVector<f64>)> = sights()
            .filter_map(|sight| {
                let (per_m, by) = self.inverse_depth(&found.x, sight)?;
                Some((sight.stereo?, per_m, by))
            })
            .collect();
        let by = DMatrix::from_fn(known.len(), found.x.len(), |row, column| {
            known[row].2[column]
        });
        Ranges {
            per_m: DVector::from_iterator(known.len(), known.iter().map(|(_, per_m, _)| *per_m)),
            covariance: &by * covariance * by.transpose(),
            stereo: known.iter().map(|(stereo, ..)| *stereo).collect(),
        }
    }

    /// The marker's inverse depth at a sight, and its derivative over the unknowns.
    fn inverse_depth(&self, x: &Unknowns, sight: &Sight) -> Option<(f64, DVector<f64>)> {
        let moment = self.prior.moment(x, sight.at);
        let per_m = Model::new(self.start, &moment).per_m(&sight.way)?;
        let mut by = SMatrix::<f64, 1, N>::zeros();
        for index in 0..N {
            let step = step_of(index);
            let mut there = moment;
            there[index] += step;
            by[index] = (Model::new(self.start, &there).per_m(&sight.way)? - per_m) / step;
        }
        let (by, places) = self.prior.spread(&by, sight.at);
        let mut all = DVector::zeros(x.len());
        for (place, value) in places.iter().zip(by.iter()) {
            all[*place] += value;
        }
        Some((per_m, all))
    }

    fn mount(&self, x: &Parameters) -> MountAngles {
        let turn = UnitQuaternion::from_scaled_axis(part(x, Parameter::MountRoll));
        mount_of(&(turn.to_rotation_matrix().into_inner() * self.start.body_from_camera))
    }

    fn rms_px(&self, found: &Found, kept: &[usize]) -> f64 {
        let square =
            |k: &usize| (found.residuals[*k] * self.sights[*k].sigma_px).norm_squared() / 2.0;
        (kept.iter().map(square).sum::<f64>() / kept.len().max(1) as f64).sqrt()
    }

    fn turned(&self) -> (f64, f64) {
        let share = |turning: &dyn Fn(f64) -> bool| {
            let rates = self.sights.iter().map(|sight| sight.way.yaw_rate_rad_s());
            rates.filter(|rate| turning(*rate)).count() as f64 / self.sights.len() as f64
        };
        (
            share(&|rate| rate < -TURNING_RAD_S),
            share(&|rate| rate > TURNING_RAD_S),
        )
    }

    fn rate_rad_s(&self) -> f64 {
        let squares = self.sights.iter().map(|s| s.way.rate_rad_s().powi(2));
        (squares.sum::<f64>() / self.sights.len() as f64).sqrt()
    }
}

/// Residual of a marker that should be behind the camera, pixels.
const UNSEEN: f64 = 3000.0;

fn cauchy_weight(length: f64, scale: f64) -> f64 {
    1.0 / (1.0 + (length / (CAUCHY * scale)).powi(2))
}

/// Step of the numerical derivative: far above rounding, far below what matters.
fn step_of(index: usize) -> f64 {
    match index {
        CLOCK => 1e-4,
        0..3 | 7..10 => 1e-7,
        _ => 1e-5,
    }
}

/// Sigma of the residuals per axis, in sights' sigmas, from their median length; never below what the
/// sights claim of themselves.
fn scale_of(residuals: &[Residual]) -> f64 {
    // Median length of a two-dimensional normal distribution of sigma 1.
    (median_length(residuals) / 1.1774).max(1.0)
}

fn median_length(residuals: &[Residual]) -> f64 {
    let mut lengths: Vec<f64> = residuals.iter().map(Residual::norm).collect();
    lengths.sort_by(f64::total_cmp);
    lengths.get(lengths.len() / 2).copied().unwrap_or(0.0)
}

/// Factor on the variance for neighbours that resemble each other: `(1 + r) / (1 - r)` for a
/// first-order process whose neighbours correlate by `r`.
fn widening(residuals: impl Iterator<Item = Residual>) -> f64 {
    let (mut power, mut along, mut before) = (1e-30, 0.0, None);
    for residual in residuals {
        power += residual.norm_squared();
        along += before.map_or(0.0, |before: Residual| before.dot(&residual));
        before = Some(residual);
    }
    let r = (along / power).clamp(0.0, 0.95);
    (1.0 + r) / (1.0 - r)
}
