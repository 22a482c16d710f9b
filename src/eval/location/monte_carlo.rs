//! Many flights with one fire each: error, promised error, bound.

use super::bound::{BoundLook, Receiver, all_at_once, bound};
use super::estimator::{Ground, Pilot, SetupError, ground_at_datum, on_ground};
use super::flight::{Course, Kind, log_uniform};
use super::law::{Draw, Law};
use super::printed::printed;
use super::score::{Scored, score};
use super::truth::{Autopilot, ErrorModel, Flame, Gnss, Lens, Seen, TrueCamera, slow, wander};
use emberfix_frames::{Covariance, MissionEnu};
use emberfix_sim::noise::{normal, stream};
use emberfix_sim::state::BodyState;
use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// What one flight is like.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Case {
    /// Way to fly.
    pub kind: Kind,
    /// Receiver.
    pub gnss: Gnss,
    /// Whether the ground is known, to 2 m.
    pub terrain: bool,
    /// Heading sigma, degrees.
    pub heading_deg: f64,
    /// Whether the eyes are 300 mm apart instead of 75 mm.
    pub wide: bool,
    /// Slant range at the start (fly-by: abeam), metres.
    pub slant_m: f64,
    /// Above the fire, metres.
    pub height_m: f64,
}

/// One sigma of the ground's height, metres.
pub const GROUND_SIGMA_M: f64 = 2.0;
/// Share of the range beyond the receiver's own error that a position's bound may be off by and
/// still counts as observable. Set before any result was seen.
pub const OBSERVABLE_SHARE: f64 = 0.1;
/// Looks of a flight at most, and seconds between two at least.
const LOOKS: usize = 80;
const LOOK_LEAST_S: f64 = 0.33;
/// Ground as steep as this share of the line of sight's own fall at most, so that no flight
/// begins beneath it.
const STEEPEST: f64 = 0.4;

impl Case {
    /// The case of the `index`-th flight: classes in turn, range and height by chance, even in
    /// their logarithms: 10 to 500 m, 8 to 120 m.
    pub fn drawn(rng: &mut ChaCha8Rng, kinds: &[Kind], index: usize) -> Self {
        let turn = index / kinds.len();
        let slant_m = log_uniform(rng, 10.5, 500.0);
        let highest = (0.85 * slant_m).min(120.0);
        Self {
            kind: kinds[index % kinds.len()],
            gnss: Gnss::ALL[turn % 2],
            terrain: (turn / 2) % 2 == 1,
            heading_deg: [0.5, 1.0, 2.0][(turn / 4) % 3],
            wide: (turn / 12) % 2 == 1,
            slant_m,
            height_m: log_uniform(rng, 8.0, highest.max(8.1)),
        }
    }

    fn lens(&self, course: &Course) -> Lens {
        let lens = if self.wide {
            Lens::wide()
        } else {
            Lens::short()
        };
        Lens {
            depression_deg: course.mean_depression_deg().clamp(0.0, 90.0),
            ..lens
        }
    }
}

/// What came of one flight.
#[derive(Debug, Clone, Serialize)]
pub struct Flown {
    /// What it was like.
    pub case: Case,
    /// Looks that saw the fire.
    pub looks: usize,
    /// First alarm.
    pub first: Option<Scored>,
    /// Last alarm.
    pub last: Option<Scored>,
    /// Root of the trace of the bound's horizontal part, metres; none where nothing holds it.
    pub bound_m: Option<f64>,
    /// Whether the bound says that the position is observable.
    pub observable: bool,
    /// The yardstick: all looks solved at once.
    pub batch: Option<Scored>,
    /// Error of P3's printed method, corrected, metres.
    pub printed_m: Option<f64>,
    /// Fires told of, or suspected, in the end; one would be right.
    pub fires: usize,
}

/// One flight up to its alarm: everything that was true and everything that was told.
pub struct Staged<'a> {
    /// The camera as meant.
    pub lens: Lens,
    /// What burns.
    pub flame: Flame,
    /// The ground as known.
    pub ground: Option<Ground>,
    /// By how much the flame stands above the known ground, metres.
    pub above_m: f64,
    /// The looks, truth and report.
    pub looks: Vec<StagedLook<'a>>,
}

/// One look.
pub struct StagedLook<'a> {
    /// What the autopilot says.
    pub autopilot: Autopilot<'a>,
    /// What the camera saw, if it saw it.
    pub seen: Option<Seen>,
    /// For the bound.
    pub truth: BoundLook,
    /// GNSS offset at that moment, metres.
    pub gnss_m: Vector3<f64>,
}

/// What a flight is staged from.
pub struct Scene<'a> {
    /// The way.
    pub course: &'a Course,
    /// The camera as meant.
    pub lens: Lens,
    /// What burns.
    pub flame: Flame,
    /// The ground as known.
    pub ground: Option<Ground>,
    /// By how much the flame stands above it, metres.
    pub above_m: f64,
    /// What the service is told about errors.
    pub errors: &'a ErrorModel,
    /// What they are drawn from.
    pub law: Law,
    /// When the camera looks, seconds.
    pub times_s: &'a [f64],
}

/// Plays a scene: errors wander, the camera looks, the autopilot reports.
pub fn stage<'a>(scene: &Scene<'a>, rng: &mut ChaCha8Rng) -> Staged<'a> {
    let wandered = wander(rng, scene.errors, scene.times_s, scene.law);
    let mut draw = Draw::new(stream(rng.random(), "looks"), scene.law);
    let mut looks = Vec::with_capacity(scene.times_s.len());
    for (t_s, slow) in scene.times_s.iter().zip(&wandered) {
        let state = scene.course.state(*t_s);
        let camera = TrueCamera {
            lens: &scene.lens,
            state: &state,
            slow,
        };
        let seen = camera.see(&scene.flame, scene.errors, &mut draw);
        looks.push(StagedLook {
            autopilot: Autopilot::new(scene.course, *t_s, slow, scene.errors, rng),
            seen,
            truth: BoundLook {
                t_s: *t_s,
                state,
                stereo: seen.is_some_and(|seen| seen.disparity_px.is_some()),
            },
            gnss_m: slow.fixed_rows::<3>(slow::GNSS).into_owned(),
        });
    }
    Staged {
        lens: scene.lens,
        flame: scene.flame,
        ground: scene.ground,
        above_m: scene.above_m,
        looks,
    }
}

/// What is worked out for a flight beside its alarms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Beside {
    /// Nothing.
    Nothing,
    /// The bound.
    Bound,
    /// The bound and all looks solved at once.
    AllAtOnce,
}

/// Flies one case and scores it; all errors are `scale` times what they usually are.
///
/// # Errors
/// [`SetupError`] when the rig is refused.
pub fn fly(
    case: Case,
    law: Law,
    scale: f64,
    beside: Beside,
    rng: &mut ChaCha8Rng,
) -> Result<Flown, SetupError> {
    let course = Course::drawn(rng, case.kind, case.slant_m, case.height_m);
    let errors = ErrorModel::of(case.gnss, case.heading_deg).scaled(scale);
    let steepest = STEEPEST * case.height_m / course.ground_range_m.max(1.0);
    let slope = (rng.random_range(-1.0..1.0) * steepest.min(0.2), 0.0);
    let ground = ground_at_datum(slope, scale * GROUND_SIGMA_M);
    let error_m = ground.sigma_m * normal(rng);
    let base_m = on_ground(&ground, 0.0, 0.0, 0.0);
    let flame = Flame {
        base_m,
        size_m: (case.slant_m / 40.0).max(1.0),
    };
    // What errs is the map, not the fire: the flight is planned about the fire.
    let known = Ground {
        height_m: ground.height_m - error_m,
        ..ground
    };
    let lens = case.lens(&course);
    let times_s = course.looks(LOOKS, LOOK_LEAST_S);
    let known = case.terrain.then_some(known);
    let scene = Scene {
        course: &course,
        lens,
        flame,
        ground: known,
        above_m: error_m,
        errors: &errors,
        law,
        times_s: &times_s,
    };
    answer(case, &errors, beside, &stage(&scene, rng))
}

fn answer(
    case: Case,
    errors: &ErrorModel,
    beside: Beside,
    staged: &Staged<'_>,
) -> Result<Flown, SetupError> {
    let mut pilot = Pilot::new(&staged.lens, errors, staged.ground)?;
    let (mut first, mut last, mut fires) = (None, None, 0);
    for look in &staged.looks {
        pilot.look(&look.autopilot, look.seen.as_slice());
        let told = pilot.fires();
        fires = told.len();
        let Some(fire) = told.into_iter().find(|fire| fire.confirmed) else {
            continue;
        };
        last = score(
            &(fire.position_m - staged.flame.base_m),
            &fire.covariance_m2,
            fire.ce90_m,
        );
        first = first.or(last);
    }
    let seeing = staged.looks.iter().filter(|look| look.seen.is_some());
    let truths: Vec<_> = seeing.clone().map(|look| look.truth.clone()).collect();
    let told: Vec<_> = seeing
        .filter_map(|look| Some((look.autopilot.report(0.0), look.seen?)))
        .collect();
    let ground = staged.ground.as_ref();
    let bound = (beside != Beside::Nothing)
        .then(|| bound(&staged.lens, errors, &staged.flame, &truths, ground))
        .flatten();
    let bound_m = bound.map(|b| (b[(0, 0)] + b[(1, 1)]).sqrt());
    let allowed =
        (2.0 * errors.gnss_horizontal_m.powi(2) + (OBSERVABLE_SHARE * case.slant_m).powi(2)).sqrt();
    let observable = bound_m.is_some_and(|bound| bound <= allowed);
    let batch = (observable && beside == Beside::AllAtOnce)
        .then(|| solve_at_once(errors, staged))
        .flatten();
    let printed = printed(&staged.lens, &told, false);
    Ok(Flown {
        case,
        looks: truths.len(),
        first,
        last,
        bound_m,
        observable,
        batch,
        printed_m: printed.map(|place| (place - staged.flame.base_m).xy().norm()),
        fires,
    })
}

fn solve_at_once(errors: &ErrorModel, staged: &Staged<'_>) -> Option<Scored> {
    let seeing = staged
        .looks
        .iter()
        .filter_map(|look| Some((look, look.seen?)));
    let seeing: Vec<_> = seeing
        .map(|(look, seen)| (&look.truth, look.autopilot.report(0.0), seen))
        .collect();
    let times_s = seeing.iter().map(|(truth, ..)| truth.t_s).collect();
    let moved: Vec<_> = seeing
        .iter()
        .map(|(_, reported, _)| (reported.position_m, reported.velocity_m_s))
        .collect();
    let strayed = Receiver::between(errors, times_s).most_likely(&moved);
    let (mut looks, mut numbers) = (Vec::new(), Vec::new());
    for ((truth, reported, seen), strayed_m) in seeing.into_iter().zip(strayed) {
        let state = BodyState {
            t_s: reported.t_s,
            position_m: reported.position_m - strayed_m,
            enu_from_body: reported.enu_from_body,
            velocity_m_s: reported.velocity_m_s,
            rate_rad_s: reported.rate_rad_s,
        };
        looks.push(BoundLook {
            state,
            ..truth.clone()
        });
        let (u, v) = seen.base_px;
        numbers.push(Vector3::new(u, v, seen.disparity_px.unwrap_or(0.0)));
    }
    let ground = staged
        .ground
        .as_ref()
        .map(|ground| (ground, staged.above_m));
    let (place, covariance) = all_at_once(
        &staged.lens,
        errors,
        &staged.flame,
        &looks,
        &numbers,
        ground,
    )?;
    let ce90_m = Covariance::<MissionEnu>::new((covariance + covariance.transpose()) * 0.5)
        .ok()?
        .ce90_m();
    score(&(place - staged.flame.base_m), &covariance, ce90_m)
}
