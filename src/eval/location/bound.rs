//! The Cramér-Rao bound of a flight: how well anybody could place the fire from these sightings.
//!
//! Bayesian (van Trees) in the errors that stay, flat in the position. Written as one batch over all
//! looks, where the estimator goes look by look: the sightings' joint covariance holds the pixels'
//! noise, the airframe's jitter and every wandering error between every two looks,
//! `C = R + sum_n s_n^2 (a_n + (1 - a_n) exp(-|t_i - t_j| / tau_n)) g_in g_jn'`, and the information about the position
//! is `J' C^-1 J` plus what the ground says. Of the receiver's errors `C` holds what the reported velocities
//! leave of them ([`Receiver`]), since the estimator has those too. Sensitivities are central differences of
//! the truth's own projection at the truth.

use super::estimator::Ground;
use super::truth::{ErrorModel, Flame, Lens, SLOW, Slow, TrueCamera, slow};
use emberfix_sim::state::BodyState;
use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, SMatrix, Vector3};

/// One look that saw the fire.
#[derive(Debug, Clone)]
pub struct BoundLook {
    /// Seconds of flight.
    pub t_s: f64,
    /// True airframe.
    pub state: BodyState,
    /// Whether it had a disparity.
    pub stereo: bool,
}

/// What a look's three numbers (column, row, disparity) do when something moves.
struct Sensitivity {
    by_position: SMatrix<f64, 3, 3>,
    by_slow: SMatrix<f64, 3, SLOW>,
    by_jitter: Matrix3<f64>,
}

/// Steps of the differences: far above rounding (1e-10 px), far below any curvature.
const METRE_STEP: f64 = 1e-3;
const RADIAN_STEP: f64 = 1e-5;
/// Stands for no knowledge of a disparity, px².
const VOID_PX2: f64 = 1e12;

/// All sightings of several flames together: their joint covariance, wandering errors included, and
/// how they follow the flames' positions (three columns per flame).
struct Batch {
    covariance: DMatrix<f64>,
    jacobian: DMatrix<f64>,
}

fn batch(lens: &Lens, errors: &ErrorModel, flames: &[(Flame, Vec<BoundLook>)]) -> Option<Batch> {
    let rows: Vec<(usize, &BoundLook, Sensitivity)> = flames
        .iter()
        .enumerate()
        .flat_map(|(index, (flame, looks))| looks.iter().map(move |look| (index, flame, look)))
        .map(|(index, flame, look)| Some((index, look, sensitivity(lens, look, flame)?)))
        .collect::<Option<_>>()?;
    let count = 3 * rows.len();
    let mut covariance = DMatrix::<f64>::zeros(count, count);
    let mut jacobian = DMatrix::<f64>::zeros(count, 3 * flames.len());
    let variances = errors.sigmas().map(|sigma| sigma * sigma);
    let (shares, correlations) = (errors.constant_shares(), errors.correlations_s());
    let receiver = Receiver::between(errors, rows.iter().map(|(_, look, _)| look.t_s).collect());
    for (i, (flame, look, by)) in rows.iter().enumerate() {
        jacobian
            .fixed_view_mut::<3, 3>(3 * i, 3 * flame)
            .copy_from(&by.by_position);
        for (j, (_, other, by_other)) in rows.iter().enumerate().take(i + 1) {
            let apart_s = (look.t_s - other.t_s).abs();
            let mut common = Slow::from_fn(|n, _| {
                let wandered = (-apart_s / correlations[n]).exp();
                variances[n] * (shares[n] + (1.0 - shares[n]) * wandered)
            });
            common
                .fixed_rows_mut::<3>(slow::GNSS)
                .copy_from(&receiver.covariance(look.t_s, other.t_s));
            let mut block =
                by.by_slow * SMatrix::from_diagonal(&common) * by_other.by_slow.transpose();
            if apart_s == 0.0 {
                block += by.by_jitter * jitter(errors) * by_other.by_jitter.transpose();
            }
            if i == j {
                block += own_noise(errors, look.stereo);
            }
            covariance
                .fixed_view_mut::<3, 3>(3 * i, 3 * j)
                .copy_from(&block);
            covariance
                .fixed_view_mut::<3, 3>(3 * j, 3 * i)
                .copy_from(&block.transpose());
        }
    }
    Some(Batch {
        covariance,
        jacobian,
    })
}

/// Information about each flame's position from its looks, without any ground: the sightings of
/// several flames share the wandering errors. Rows and columns: three per flame.
#[must_use]
pub fn information(
    lens: &Lens,
    errors: &ErrorModel,
    flames: &[(Flame, Vec<BoundLook>)],
) -> Option<DMatrix<f64>> {
    let batch = batch(lens, errors, flames)?;
    let solved = batch.covariance.cholesky()?.solve(&batch.jacobian);
    Some(batch.jacobian.transpose() * solved)
}

/// The yardstick for estimators that go look by look: one generalised least squares solution over
/// all looks at once, by Gauss-Newton from the truth, with the covariance of its last step. What it
/// leaves is what curvature alone costs. `looks` hold the airframe as reported, less the receiver's most
/// likely errors ([`Receiver::most_likely`]); `seen` their columns,
/// rows and disparities (any number where there was none).
#[must_use]
pub fn all_at_once(
    lens: &Lens,
    errors: &ErrorModel,
    truth: &Flame,
    looks: &[BoundLook],
    seen: &[Vector3<f64>],
    ground: Option<(&Ground, f64)>,
) -> Option<(Vector3<f64>, Matrix3<f64>)> {
    let mut flame = *truth;
    let mut covariance = Matrix3::identity();
    for _ in 0..PASSES {
        let batch = batch(lens, errors, &[(flame, looks.to_vec())])?;
        let mut left = DVector::<f64>::zeros(3 * seen.len());
        for (i, (look, seen)) in looks.iter().zip(seen).enumerate() {
            let predicted = numbers(lens, &look.state, &Slow::zeros(), &Vector3::zeros(), &flame)?;
            left.fixed_rows_mut::<3>(3 * i)
                .copy_from(&(seen - predicted));
        }
        let factor = batch.covariance.cholesky()?;
        let mut information: Matrix3<f64> = (batch.jacobian.transpose()
            * factor.solve(&batch.jacobian))
        .fixed_view::<3, 3>(0, 0)
        .into_owned();
        let mut pull: Vector3<f64> = (batch.jacobian.transpose() * factor.solve(&left))
            .fixed_rows::<3>(0)
            .into_owned();
        if let Some((ground, above_m)) = ground {
            let normal = Vector3::new(-ground.slope.0, -ground.slope.1, 1.0);
            // The truth is `above_m` above the known ground.
            let height = above_m + normal.dot(&(flame.base_m - truth.base_m));
            information += ground_information(ground);
            pull -= normal * height / (ground.sigma_m * ground.sigma_m);
        }
        covariance = information.try_inverse()?;
        let step = covariance * pull;
        flame.base_m += step;
        if step.norm() < 1e-4 {
            break;
        }
    }
    Some((flame.base_m, covariance))
}

/// Passes of [`all_at_once`] at most.
const PASSES: usize = 8;

/// The bound of one flame's position covariance, m²; `None` where nothing holds the position.
#[must_use]
pub fn bound(
    lens: &Lens,
    errors: &ErrorModel,
    flame: &Flame,
    looks: &[BoundLook],
    ground: Option<&Ground>,
) -> Option<Matrix3<f64>> {
    let information = information(lens, errors, &[(*flame, looks.to_vec())])?;
    let mut information: Matrix3<f64> = information.fixed_view::<3, 3>(0, 0).into_owned();
    if let Some(ground) = ground {
        information += ground_information(ground);
    }
    // A singular one is void, not exact: rounding must not turn it into a bound.
    let scaled = information.symmetric_eigenvalues();
    (scaled.min() > 1e-12 * scaled.max())
        .then(|| information.try_inverse())
        .flatten()
}

/// The ground holds one direction, as well as it is known.
fn ground_information(ground: &Ground) -> Matrix3<f64> {
    let normal = Vector3::new(-ground.slope.0, -ground.slope.1, 1.0);
    normal * normal.transpose() / (ground.sigma_m * ground.sigma_m)
}

/// The receiver's errors at the times of some looks, as the reported velocities leave them.
///
/// Between two looks the reported position moves by the way and by what the error changes; the velocities,
/// summed up by trapezoids, say the way but for what *they* err. So differences of the error are seen,
/// `d = H e + n`, and the covariance of `e` is `C - C H' (H C H' + N)^-1 H C`, per axis.
pub struct Receiver {
    times_s: Vec<f64>,
    /// East and north alike, then up: covariance, and what a change that was seen is weighed with.
    axes: [(DMatrix<f64>, DMatrix<f64>); 2],
}

impl Receiver {
    /// At times in any order.
    #[must_use]
    pub fn between(errors: &ErrorModel, mut times_s: Vec<f64>) -> Self {
        times_s.sort_by(f64::total_cmp);
        times_s.dedup();
        let axes = [errors.gnss_horizontal_m, errors.gnss_vertical_m]
            .map(|sigma_m| along_axis(errors, sigma_m, &times_s));
        Self { times_s, axes }
    }

    /// Variances common to two of the times: east, north, up, m².
    fn covariance(&self, one_s: f64, other_s: f64) -> Vector3<f64> {
        let at = |t_s: f64| self.times_s.partition_point(|time| *time < t_s);
        let [flat, up] = [0, 1].map(|axis| self.axes[axis].0[(at(one_s), at(other_s))]);
        Vector3::new(flat, flat, up)
    }

    /// Most likely errors at each of the times, metres, given positions and velocities as reported.
    #[must_use]
    pub fn most_likely(&self, reported: &[(Vector3<f64>, Vector3<f64>)]) -> Vec<Vector3<f64>> {
        let changes: Vec<Vector3<f64>> = reported
            .windows(2)
            .zip(self.times_s.windows(2))
            .map(|(pair, times_s)| {
                let way = (pair[0].1 + pair[1].1) * (0.5 * (times_s[1] - times_s[0]));
                pair[1].0 - pair[0].0 - way
            })
            .collect();
        let along = |axis: usize| {
            let changes = DVector::from_iterator(changes.len(), changes.iter().map(|c| c[axis]));
            &self.axes[axis / 2].1 * changes
        };
        let [east, north, up] = [0, 1, 2].map(along);
        (0..reported.len())
            .map(|i| Vector3::new(east[i], north[i], up[i]))
            .collect()
    }
}

fn along_axis(errors: &ErrorModel, sigma_m: f64, times_s: &[f64]) -> (DMatrix<f64>, DMatrix<f64>) {
    let count = times_s.len();
    let share = errors.gnss_constant_share;
    let forgotten = |i: usize, j: usize, correlation_s: f64| {
        (-(times_s[i] - times_s[j]).abs() / correlation_s).exp()
    };
    let error = DMatrix::from_fn(count, count, |i, j| {
        let wanders = (1.0 - share) * forgotten(i, j, errors.gnss_correlation_s);
        let new = if i == j {
            errors.position_noise_m.powi(2)
        } else {
            0.0
        };
        sigma_m * sigma_m * (share + wanders) + new
    });
    let velocity = DMatrix::from_fn(count, count, |i, j| {
        errors.velocity_m_s.powi(2) * forgotten(i, j, errors.velocity_correlation_s)
    });
    let steps = count.saturating_sub(1);
    let differences = DMatrix::from_fn(steps, count, |i, j| match j.checked_sub(i) {
        Some(0) => -1.0_f64,
        Some(1) => 1.0,
        _ => 0.0,
    });
    let trapezoids = DMatrix::from_fn(steps, count, |i, j| {
        0.5 * (times_s[i + 1] - times_s[i]) * differences[(i, j)].abs()
    });
    let seen = &differences * &error;
    let spread = &seen * differences.transpose() + &trapezoids * velocity * trapezoids.transpose();
    let gain = spread
        .cholesky()
        .map_or_else(
            || DMatrix::zeros(steps, count),
            |factor| factor.solve(&seen),
        )
        .transpose();
    (&error - &gain * &seen, gain)
}

/// Of the airframe's attitude; the position's is among the receiver's errors.
fn jitter(errors: &ErrorModel) -> Matrix3<f64> {
    Matrix3::identity() * errors.attitude_noise_rad.powi(2)
}

fn own_noise(errors: &ErrorModel, stereo: bool) -> Matrix3<f64> {
    let disparity = if stereo {
        errors.disparity_px.powi(2)
    } else {
        VOID_PX2
    };
    Matrix3::from_diagonal(&Vector3::new(
        errors.pixel_px.powi(2),
        errors.pixel_px.powi(2),
        disparity,
    ))
}

/// The airframe that truly is when the one that is reported errs by `slow` and jitters.
fn erring(state: &BodyState, slow: &Slow, jitter: &Vector3<f64>) -> BodyState {
    let gnss: Vector3<f64> = slow.fixed_rows::<3>(slow::GNSS).into_owned();
    let clock = slow[slow::CLOCK];
    let moved = gnss + state.velocity_m_s * clock;
    let tilt = Vector3::new(slow[slow::TILT], slow[slow::TILT + 1], 0.0);
    let turn = tilt + jitter + state.rate_rad_s * clock;
    let heading = Rotation3::from_axis_angle(&Vector3::z_axis(), slow[slow::HEADING]);
    BodyState {
        position_m: state.position_m - moved,
        enu_from_body: heading.into_inner()
            * state.enu_from_body
            * Rotation3::from_scaled_axis(-turn).into_inner(),
        ..*state
    }
}

fn numbers(
    lens: &Lens,
    state: &BodyState,
    slow: &Slow,
    jitter: &Vector3<f64>,
    flame: &Flame,
) -> Option<Vector3<f64>> {
    let state = erring(state, slow, jitter);
    let camera = TrueCamera {
        lens,
        state: &state,
        slow,
    };
    let sight = camera.sight(flame)?;
    Some(Vector3::new(sight.base.x, sight.base.y, sight.middle.z))
}

fn sensitivity(lens: &Lens, look: &BoundLook, flame: &Flame) -> Option<Sensitivity> {
    let none = Vector3::zeros();
    let column = |plus: Option<Vector3<f64>>, minus: Option<Vector3<f64>>, step: f64| {
        Some((plus? - minus?) / (2.0 * step))
    };
    let mut by = Sensitivity {
        by_position: SMatrix::zeros(),
        by_slow: SMatrix::zeros(),
        by_jitter: Matrix3::zeros(),
    };
    for axis in 0..3 {
        let at = |step: f64| {
            let mut moved = *flame;
            moved.base_m[axis] += step;
            numbers(lens, &look.state, &Slow::zeros(), &none, &moved)
        };
        by.by_position
            .set_column(axis, &column(at(METRE_STEP), at(-METRE_STEP), METRE_STEP)?);
    }
    for n in 0..SLOW {
        let step = match n {
            slow::HEADING..slow::DISPARITY => RADIAN_STEP,
            _ => METRE_STEP,
        };
        let at = |step: f64| {
            let mut slow = Slow::zeros();
            slow[n] = step;
            numbers(lens, &look.state, &slow, &none, flame)
        };
        by.by_slow
            .set_column(n, &column(at(step), at(-step), step)?);
    }
    for n in 0..3 {
        let at = |step: f64| {
            let mut jitter = none;
            jitter[n] = step;
            numbers(lens, &look.state, &Slow::zeros(), &jitter, flame)
        };
        by.by_jitter
            .set_column(n, &column(at(RADIAN_STEP), at(-RADIAN_STEP), RADIAN_STEP)?);
    }
    Some(by)
}

/// Standard deviation of the horizontal difference of two flames along the line that joins them.
#[must_use]
pub fn apart_sigma_m(information: &DMatrix<f64>, along: &Vector3<f64>) -> Option<f64> {
    let covariance = information.clone().cholesky()?.inverse();
    let mut weights = DVector::<f64>::zeros(6);
    weights.fixed_rows_mut::<3>(0).copy_from(along);
    weights.fixed_rows_mut::<3>(3).copy_from(&-along);
    Some(weights.dot(&(covariance * &weights)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::location::flight::{Course, Kind};
    use crate::eval::location::truth::Gnss;
    use emberfix_sim::noise::stream;

    fn looks(kind: Kind, slant_m: f64, stereo: bool) -> (Lens, Vec<BoundLook>) {
        let course = Course::drawn(&mut stream(2, "bound"), kind, slant_m, 0.5 * slant_m);
        let lens = Lens {
            depression_deg: course.mean_depression_deg(),
            ..Lens::short()
        };
        let looks = course
            .looks(30, 0.3)
            .into_iter()
            .map(|t_s| BoundLook {
                t_s,
                state: course.state(t_s),
                stereo,
            })
            .collect();
        (lens, looks)
    }

    fn horizontal_sigma(kind: Kind, slant_m: f64, gnss: Gnss, stereo: bool) -> Option<f64> {
        let (lens, looks) = looks(kind, slant_m, stereo);
        let flame = Flame {
            base_m: Vector3::zeros(),
            size_m: 1.0,
        };
        let errors = ErrorModel::of(gnss, 2.0);
        let bound = bound(&lens, &errors, &flame, &looks, None)?;
        Some((bound[(0, 0)] + bound[(1, 1)]).sqrt())
    }

    /// limits.md T11: an orbit with a consumer receiver is as good as the receiver (1.5 m per axis:
    /// 2.1 m), and RTK brings it to decimetres; a hover sees a bearing only.
    #[test]
    fn orbits_are_as_good_as_the_receiver_and_hovering_needs_stereo() {
        let orbit = |gnss| horizontal_sigma(Kind::Orbit, 50.0, gnss, false).unwrap();
        let consumer = orbit(Gnss::Consumer);
        assert!((1.5..2.2).contains(&consumer), "{consumer}");
        let rtk = orbit(Gnss::Rtk);
        assert!(rtk < 0.5, "{rtk}");
        let hover = |stereo| horizontal_sigma(Kind::Hover, 50.0, Gnss::Rtk, stereo);
        // Swaying by 0.3 m is all the parallax there is.
        let (mono, stereo) = (hover(false).unwrap_or(f64::INFINITY), hover(true).unwrap());
        assert!(mono > stereo && stereo < 4.0, "{mono} {stereo}");
    }

    #[test]
    fn more_looks_never_worsen_the_bound() {
        let (lens, looks) = looks(Kind::FlyBy, 80.0, true);
        let flame = Flame {
            base_m: Vector3::zeros(),
            size_m: 1.0,
        };
        let errors = ErrorModel::of(Gnss::Consumer, 1.0);
        let sigma = |count: usize| {
            let bound = bound(&lens, &errors, &flame, &looks[..count], None).unwrap();
            bound.trace()
        };
        assert!(sigma(10) >= sigma(15) && sigma(15) >= sigma(20));
    }
}
