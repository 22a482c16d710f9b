//! The looks at one fire that are kept, and the fire solved from them.
//!
//! A filter takes each look in where it believes the fire to be at that moment. When the range was
//! hardly known then, that was the wrong place, and slopes that were taken at different places
//! contradict each other: the filter becomes surer than it should be. So the latest [`LOOKS`] looks
//! are kept as they were seen, and solved again, all of them linearised where the fire is believed to
//! be *now*: Gauss-Newton, each pass a run of the filter (Bell and Cathey, "The iterated Kalman filter
//! update as a Gauss-Newton method", IEEE TAC 38(2), 1993). What is older is folded into what the run
//! begins with, linearised where it was last (fixed-lag smoothing, as in Sibley, Matthies, Sukhatme,
//! "Sliding window filter", 2010).

use super::chart::{Chart, INVERSE_DEPTH, OF_FIRE, TANGENTS};
use super::ground::LocalGround;
use super::joint::{Joint, JointVector, Pace, Scatter};
use super::look::{Look, shared};
use super::odometer::{Flown, Reading};
use crate::locate::{CONSTANT, Shared, Shot, Sighting, WANDERING};
use std::sync::Arc;

/// Looks that are kept.
pub const LOOKS: usize = 64;
/// Looks that are folded away together once there are more.
const FOLDED: usize = 16;
/// Passes of one solution at most, and the step that ends it, in sigmas.
const PASSES: usize = 6;
const SMALL_STEP: f64 = 0.05;

/// Index of the clock error in the joint numbers.
pub const CLOCK: usize = OF_FIRE + Shared::Clock as usize;

/// One look at a fire.
#[derive(Debug, Clone)]
pub struct Kept {
    /// The shutter.
    pub shot: Arc<Shot>,
    /// What it showed.
    pub sighting: Sighting,
    /// The odometer at that moment.
    pub reading: Reading,
    /// What of the reported way since the first look was surely flown.
    pub flown: Flown,
}

/// The latest looks at a fire, and what was known before them.
#[derive(Debug, Clone)]
pub struct Window {
    before: Box<Joint>,
    before_at: Reading,
    looks: Vec<Kept>,
    /// Whether `before` holds what the ground says.
    ground_is_folded: bool,
}

/// About what a window is solved.
#[derive(Debug, Clone, Copy)]
pub struct About<'a> {
    /// Fire and errors as believed.
    pub at: &'a JointVector,
    /// When the errors are those, which wander.
    pub when: &'a Reading,
    /// One sigma of the clock error, in its prior sigmas.
    pub clock_sigma: f64,
    /// How much more noise there is than was said.
    pub scatter: Scatter,
}

impl Window {
    /// No look yet.
    #[must_use]
    pub fn new(before: Joint, before_at: Reading) -> Self {
        Self {
            before: Box::new(before),
            before_at,
            looks: Vec::new(),
            ground_is_folded: false,
        }
    }

    /// Looks that are kept.
    #[must_use]
    pub fn count(&self) -> usize {
        self.looks.len()
    }

    /// Whether the ground may still be taken in.
    #[must_use]
    pub fn wants_ground(&self) -> bool {
        !self.ground_is_folded
    }

    /// One more look.
    pub fn add(&mut self, look: Kept) {
        self.looks.push(look);
    }

    /// Whether looks are to be folded away.
    #[must_use]
    pub fn is_over(&self) -> bool {
        self.looks.len() > LOOKS
    }

    /// Folds the oldest looks, and the ground, into what a solution begins with.
    pub fn fold(
        &mut self,
        chart: &Chart,
        about: &About<'_>,
        pace: &Pace,
        ground: Option<&LocalGround>,
    ) {
        if let Some(ground) = ground.filter(|_| !self.ground_is_folded) {
            ground.hold(&mut self.before, chart, about.at);
            self.ground_is_folded = true;
        }
        let folded: Vec<Kept> = self.looks.drain(..FOLDED.min(self.looks.len())).collect();
        let (joint, at) = (self.before.as_mut(), &mut self.before_at);
        run(&folded, joint, at, chart, about, pace);
    }

    /// The fire and its errors at the latest look, from all looks linearised where the fire is.
    #[must_use]
    pub fn solve(
        &self,
        chart: &Chart,
        about: &About<'_>,
        pace: &Pace,
        ground: Option<&LocalGround>,
    ) -> (Joint, Reading) {
        let (mut joint, mut when) = self.pass(chart, about, pace, ground);
        let mut at = *about.at;
        for _ in 1..PASSES {
            if is_small(&joint, &at) {
                break;
            }
            at = Joint::clamped(*joint.mean(), at[INVERSE_DEPTH]);
            let next = About {
                at: &at,
                when: &when,
                clock_sigma: joint.sigma(CLOCK),
                scatter: about.scatter,
            };
            (joint, when) = self.pass(chart, &next, pace, ground);
        }
        (joint, when)
    }

    fn pass(
        &self,
        chart: &Chart,
        about: &About<'_>,
        pace: &Pace,
        ground: Option<&LocalGround>,
    ) -> (Joint, Reading) {
        let (mut joint, mut at) = (self.before.as_ref().clone(), self.before_at);
        if let Some(ground) = ground.filter(|_| !self.ground_is_folded) {
            ground.hold(&mut joint, chart, about.at);
        }
        run(&self.looks, &mut joint, &mut at, chart, about, pace);
        (joint, at)
    }
}

/// The filter over some looks.
fn run(
    looks: &[Kept],
    joint: &mut Joint,
    at: &mut Reading,
    chart: &Chart,
    about: &About<'_>,
    pace: &Pace,
) {
    for look in looks {
        joint.age(at, &look.reading, pace);
        *at = look.reading;
        let point = about.at_look(look, pace);
        let lens = look.shot.lens(&shared(&point), about.clock_sigma);
        let measured = Look {
            sighting: &look.sighting,
            lens: &lens,
            up: look.shot.up(),
            flown: &look.flown,
        }
        .measure(chart, &point);
        if let Some(mut measured) = measured {
            measured.noise *= about.scatter.variance();
            joint.take(&measured, &point);
        }
    }
}

impl About<'_> {
    /// Fire and errors as they most likely were at a look: what wanders was, as far as is known of it
    /// now, a share of what it is now.
    fn at_look(&self, look: &Kept, pace: &Pace) -> JointVector {
        let mut point = *self.at;
        let keeps = pace.keeps((self.when.at - look.reading.at).as_secs_f64());
        for (i, keep) in (0..WANDERING).zip(keeps) {
            point[OF_FIRE + CONSTANT + i] *= keep;
        }
        point[CLOCK] = look.shot.held_clock(point[CLOCK]);
        point
    }
}

fn is_small(joint: &Joint, at: &JointVector) -> bool {
    let step = joint.mean() - at;
    let is_small = |i: usize| step[i].abs() <= SMALL_STEP * joint.sigma(i).max(1e-12);
    (TANGENTS..OF_FIRE).all(is_small) && is_small(CLOCK)
}
