//! How far off the position is, and whether it says so: a Monte Carlo without pictures.
//!
//! **In:** numbers of flights and a seed. **Out:** the figures of the estimator, next to the
//! Cramér-Rao bound and to P3's printed method on the same sightings. Truth (flight, projection,
//! errors) is written here and in the simulator, apart from the rooms that are measured; those are
//! reached through [`estimator`] only. **Assumptions.** Sightings are what a detector and a matcher
//! would say, with their noise: no pictures are drawn. **Known limits.** One lens model without
//! distortion; plane ground, tilted.

pub mod bound;
pub mod cells;
pub mod estimator;
pub mod flight;
pub mod incidents;
pub mod law;
pub mod monte_carlo;
pub mod mount;
pub mod p3;
mod plots;
pub mod printed;
pub mod score;
pub mod speed;
mod summary;
pub mod truth;

use super::Report;
use emberfix_sim::noise::stream;
use estimator::SetupError;
use flight::Kind;
use incidents::Incidents;
use indicatif::ProgressBar;
use law::Law;
use monte_carlo::{Beside, Case, Flown, fly};
use mount::{Air, MountFlown};
use p3::P3Flown;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use truth::Gnss;

/// What to measure.
#[derive(Debug, Clone)]
pub struct Options {
    /// Flights of the Monte Carlo.
    pub flights: usize,
    /// Flights under each law that the estimator does not assume.
    pub foreign_flights: usize,
    /// Flights like P3's.
    pub p3_flights: usize,
    /// Orbits with a bent mount and a late clock, in gusts; as many in steady air.
    pub mount_flights: usize,
    /// Flights over one fire, and over two.
    pub incident_flights: usize,
    /// Fires in the picture when a frame is timed, one run each.
    pub timed_fires: Vec<usize>,
    /// Seed of everything but times.
    pub seed: u64,
    /// All errors of the Monte Carlo times this.
    pub errors: f64,
    /// Ways to fly.
    pub kinds: Vec<Kind>,
}

/// One flight in so many (prime to the classes' turns) is solved all at once as well.
const AT_ONCE: usize = 7;

/// Everything that was flown.
#[derive(Debug, Clone)]
pub struct Campaign {
    /// Errors as assumed.
    pub flown: Vec<Flown>,
    /// Errors as not assumed.
    pub foreign: Vec<(Law, Vec<Flown>)>,
    /// P3's flight.
    pub p3: Vec<P3Flown>,
    /// Bent mounts and late clocks in gusts, RTK and a good heading.
    pub gusty: Vec<MountFlown>,
    /// The same with a consumer receiver and compass.
    pub gusty_consumer: Vec<MountFlown>,
    /// Late clocks in steady air.
    pub steady: Vec<MountFlown>,
    /// Over one fire.
    pub one: Vec<Incidents>,
    /// Over two.
    pub two: Vec<Incidents>,
    /// Fires in the picture, milliseconds per frame, fires kept.
    pub times: Vec<(usize, f64, usize)>,
}

impl Options {
    /// Steps of the progress bar.
    #[must_use]
    pub fn total(&self) -> u64 {
        let flights = self.flights
            + Law::FOREIGN.len() * self.foreign_flights
            + self.p3_flights
            + 3 * self.mount_flights
            + 2 * self.incident_flights
            + self.timed_fires.len();
        flights as u64
    }

    /// Runs `count` flights in parallel, each with a stream of its own: the same for a seed
    /// whatever the threads.
    fn each<T: Send>(
        &self,
        purpose: &str,
        count: usize,
        bar: &ProgressBar,
        one: impl Fn(usize, &mut ChaCha8Rng) -> Result<T, SetupError> + Sync,
    ) -> Result<Vec<T>, SetupError> {
        let run = |index: usize| {
            let done = one(index, &mut stream(self.seed, &format!("{purpose} {index}")));
            bar.inc(1);
            done
        };
        (0..count).into_par_iter().map(run).collect()
    }

    /// Flies the Monte Carlo under a law.
    ///
    /// # Errors
    /// [`SetupError`] when a rig is refused.
    pub fn fly(&self, law: Law, count: usize, bar: &ProgressBar) -> Result<Vec<Flown>, SetupError> {
        self.each(&format!("{law:?}"), count, bar, |index, rng| {
            let beside = match law {
                Law::Assumed if (index / self.kinds.len()).is_multiple_of(AT_ONCE) => {
                    Beside::AllAtOnce
                }
                Law::Assumed => Beside::Bound,
                _ => Beside::Nothing,
            };
            let case = Case::drawn(rng, &self.kinds, index);
            fly(case, law, self.errors, beside, rng)
        })
    }

    /// Flies everything.
    ///
    /// # Errors
    /// [`SetupError`] when a rig is refused.
    pub fn campaign(&self, bar: &ProgressBar) -> Result<Campaign, SetupError> {
        let mut foreign = Vec::new();
        for law in Law::FOREIGN {
            foreign.push((law, self.fly(law, self.foreign_flights, bar)?));
        }
        let incidents = self.incident_flights;
        Ok(Campaign {
            flown: self.fly(Law::Assumed, self.flights, bar)?,
            foreign,
            p3: self.each("p3", self.p3_flights, bar, |_, rng| p3::fly(rng))?,
            gusty: self.mounts(Air::Gusty(Gnss::Rtk), bar)?,
            gusty_consumer: self.mounts(Air::Gusty(Gnss::Consumer), bar)?,
            steady: self.mounts(Air::Steady, bar)?,
            one: self.each("one fire", incidents, bar, |_, rng| {
                incidents::one_fire(rng)
            })?,
            two: self.each("two fires", incidents, bar, |_, rng| {
                incidents::two_fires(rng)
            })?,
            times: self.times(bar)?,
        })
    }

    fn mounts(&self, air: Air, bar: &ProgressBar) -> Result<Vec<MountFlown>, SetupError> {
        let purpose = format!("mount {air:?}");
        let flown = self.each(&purpose, self.mount_flights, bar, |_, rng| {
            mount::fly(rng, air)
        })?;
        Ok(flown.into_iter().flatten().collect())
    }

    /// One after the other, so that nothing else runs beside them.
    fn times(&self, bar: &ProgressBar) -> Result<Vec<(usize, f64, usize)>, SetupError> {
        let one = |&count: &usize| {
            let (ms, kept) = speed::step_ms(count, self.seed)?;
            bar.inc(1);
            Ok((count, ms, kept))
        };
        self.timed_fires.iter().map(one).collect()
    }
}

/// Measures everything.
///
/// # Errors
/// [`SetupError`] when a rig is refused.
pub fn measure(options: &Options, bar: &ProgressBar) -> Result<Report, SetupError> {
    Ok(summary::report(options, &options.campaign(bar)?))
}
