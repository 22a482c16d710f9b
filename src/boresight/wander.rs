//! What of the autopilot's errors wanders while the flight goes on, and all that is known beforehand.
//!
//! Heading, tilt and GNSS each err by a constant and by a first-order Gauss-Markov process (Gelb, *Applied
//! Optimal Estimation*, 1974, section 3.8). A process stands in the search as its values at even moments
//! (knots), joined by straight lines; from one to the next it keeps the share `exp(-step / correlation)`.
//! Constants alone would be believed the more firmly the more pictures there are, and would press into the
//! mount what wandered.

use super::model::{N, Parameter, Parameters, Sight, Start};
use emberfix_frames::ServiceTime;
use nalgebra::{DMatrix, DVector, SMatrix, SVector};

/// Errors that wander: heading, tilt about east and north, GNSS east, north and up, as they follow each other
/// among the parameters.
pub(super) const WANDERING: usize = Parameter::Marker as usize - Parameter::Heading as usize;
/// The first of them among the parameters.
const FIRST: usize = Parameter::Heading as usize;
/// Parts of the unknowns on which one sight depends: the constants, and two neighbouring knots.
pub(super) const TOUCHED: usize = N + 2 * WANDERING;
/// Knots in the shortest correlation time: what a process does between two of them, a straight line does not
/// follow; with five, the mount's sigmas were told a fifth too small.
const KNOTS_PER_CORRELATION: f64 = 15.0;
/// Most knots, which bounds the time that a solution takes; a longer flight has them further apart.
const MOST_KNOTS: usize = 120;
/// Smallest sigma, in the parameter's unit: an error that is not there.
const STILL: f64 = 1e-7;

/// How one error wanders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wandering {
    /// One sigma, in the parameter's unit.
    pub sigma: f64,
    /// Seconds after which it has become another one.
    pub correlation_s: f64,
}

/// The unknowns of a flight: the constants ([`Parameters`]), then [`WANDERING`] values at each knot.
pub(super) type Unknowns = DVector<f64>;

/// Where in time the knots are, and what is known of all unknowns beforehand.
#[derive(Debug, Clone)]
pub(super) struct Prior {
    begin: ServiceTime,
    step_s: f64,
    knots: usize,
    mean: Unknowns,
    information: DMatrix<f64>,
    /// One sigma of every unknown.
    sigmas: DVector<f64>,
}

impl Prior {
    /// For a flight's sights.
    pub fn new(start: &Start, sights: &[Sight]) -> Self {
        let times = || sights.iter().map(|sight| sight.at);
        let begin = times().min().unwrap_or(ServiceTime::from_unix_ns(0));
        let lasts_s = times().max().map_or(0.0, |end| (end - begin).as_secs_f64());
        let shortest_s = start
            .wandering
            .iter()
            .map(|one| one.correlation_s)
            .fold(f64::MAX, f64::min);
        let wanted = (lasts_s * KNOTS_PER_CORRELATION / shortest_s).ceil() as usize;
        let knots = wanted.clamp(1, MOST_KNOTS - 1) + 1;
        let mut prior = Self {
            begin,
            step_s: (lasts_s / (knots - 1) as f64).max(1e-3),
            knots,
            mean: DVector::zeros(N + WANDERING * knots),
            information: DMatrix::zeros(N + WANDERING * knots, N + WANDERING * knots),
            sigmas: DVector::zeros(N + WANDERING * knots),
        };
        prior.know_constants(start);
        for (axis, wandering) in start.wandering.iter().enumerate() {
            prior.know_wandering(axis, *wandering);
        }
        prior
    }

    fn know_constants(&mut self, start: &Start) {
        if let Some(marker_m) = start.marker_m {
            self.mean
                .fixed_rows_mut::<3>(Parameter::Marker as usize)
                .copy_from(&marker_m);
        }
        for (index, sigma) in start.sigmas.iter().enumerate() {
            let sigma = sigma.max(STILL);
            self.sigmas[index] = sigma;
            self.information[(index, index)] = sigma.powi(-2);
        }
    }

    /// The first value by its sigma, each further one by what it keeps of the one before.
    fn know_wandering(&mut self, axis: usize, wandering: Wandering) {
        let sigma = wandering.sigma.max(STILL);
        let keep = (-self.step_s / wandering.correlation_s).exp();
        let renewed = sigma.powi(-2) / (1.0 - keep * keep);
        let at = |knot: usize| N + knot * WANDERING + axis;
        self.information[(at(0), at(0))] += sigma.powi(-2);
        for (before, after) in (0..self.knots).map(at).zip((1..self.knots).map(at)) {
            self.information[(before, before)] += keep * keep * renewed;
            self.information[(after, after)] += renewed;
            self.information[(before, after)] -= keep * renewed;
            self.information[(after, before)] -= keep * renewed;
        }
        for knot in 0..self.knots {
            self.sigmas[at(knot)] = sigma;
        }
    }

    /// What is believed before the first sight.
    pub fn mean(&self) -> &Unknowns {
        &self.mean
    }

    /// Inverse covariance of the unknowns beforehand.
    pub fn information(&self) -> &DMatrix<f64> {
        &self.information
    }

    /// One sigma of every unknown beforehand.
    pub fn sigmas(&self) -> &DVector<f64> {
        &self.sigmas
    }

    /// Square of the distance from what was known, in its sigmas.
    pub fn distance_squared(&self, x: &Unknowns) -> f64 {
        let off = x - &self.mean;
        (&self.information * &off).dot(&off)
    }

    /// The knot before a moment, and how far the moment is on the way to the next, 0..1.
    fn place(&self, at: ServiceTime) -> (usize, f64) {
        let place = ((at - self.begin).as_secs_f64() / self.step_s).max(0.0);
        let knot = (place as usize).min(self.knots - 2);
        (knot, (place - knot as f64).min(1.0))
    }

    /// The parameters as they are at one moment.
    pub fn moment(&self, x: &Unknowns, at: ServiceTime) -> Parameters {
        let (knot, share) = self.place(at);
        let value = |knot: usize| x.fixed_rows::<WANDERING>(N + knot * WANDERING);
        let wandered: SVector<f64, WANDERING> =
            value(knot) * (1.0 - share) + value(knot + 1) * share;
        let mut parameters: Parameters = x.fixed_rows::<N>(0).into_owned();
        let mut wandering = parameters.fixed_rows_mut::<WANDERING>(FIRST);
        wandering += wandered;
        parameters
    }

    /// Derivatives over the unknowns that a sight at a moment touches, from those over the parameters at
    /// that moment; and which unknowns these are.
    pub fn spread<const ROWS: usize>(
        &self,
        by: &SMatrix<f64, ROWS, N>,
        at: ServiceTime,
    ) -> (SMatrix<f64, ROWS, TOUCHED>, [usize; TOUCHED]) {
        let (knot, share) = self.place(at);
        let mut all = SMatrix::<f64, ROWS, TOUCHED>::zeros();
        all.fixed_columns_mut::<N>(0).copy_from(by);
        let wandering = by.fixed_columns::<WANDERING>(FIRST);
        all.fixed_columns_mut::<WANDERING>(N)
            .copy_from(&(wandering * (1.0 - share)));
        all.fixed_columns_mut::<WANDERING>(N + WANDERING)
            .copy_from(&(wandering * share));
        let first = N + knot * WANDERING;
        // The two knots follow each other among the unknowns.
        let place = |touched: usize| {
            if touched < N {
                touched
            } else {
                first + touched - N
            }
        };
        (all, std::array::from_fn(place))
    }
}
