//! One fire must stay one incident, and two must stay two, through misses, false boxes, trees in
//! the way and errors that wander.

use super::bound::{BoundLook, apart_sigma_m, information};
use super::estimator::{Pilot, SetupError, ground_at_datum};
use super::flight::{Course, Kind, log_uniform};
use super::law::{Draw, Law};
use super::monte_carlo::GROUND_SIGMA_M;
use super::truth::{
    Autopilot, ErrorModel, Flame, Gnss, IMAGE_PX, Lens, Seen, Slow, TrueCamera, wander,
};
use emberfix_sim::noise::stream;
use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::BTreeSet;

/// Share of looks in which the detector misses a fire that is in the picture.
pub const MISS: f64 = 0.2;
/// Share of looks with a box where nothing burns.
pub const FALSE_BOX: f64 = 0.05;
/// Length of the orbits for one fire, and looks per second.
const ORBIT_S: f64 = 300.0;
const LOOKS_PER_S: f64 = 2.0;
/// Times that trees stand in the way, and how long, seconds.
const OCCLUSIONS: usize = 4;
const OCCLUDED_S: std::ops::Range<f64> = 3.0..20.0;
/// Boxes that overlap by more than this (intersection over union) are one to the detector.
const NMS_IOU: f64 = 0.5;
/// A fire's width in the picture from the start of a flight with two, pixels: what a detector needs.
const LEAST_PX: f64 = 10.0;
/// Looks after which the sigma between two fires is taken from the bound.
pub const SIGMA_LOOKS: usize = 10;
/// Sigmas between two fires.
pub const SIGMAS_APART: f64 = 3.0;

/// What became of a flight over fires.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Incidents {
    /// Fires that are there.
    pub fires: usize,
    /// Incidents that were told, ever.
    pub told: usize,
    /// Incidents that were told and not merged in the end.
    pub left: usize,
    /// Distance between two fires, metres.
    pub apart_m: f64,
    /// Whether sigmas, not the detector's own limit, set that distance.
    pub sigma_sets: bool,
}

struct Watch<'a> {
    course: &'a Course,
    lens: Lens,
    errors: ErrorModel,
    times_s: Vec<f64>,
    flames: Vec<Flame>,
    wandered: Vec<Slow>,
}

/// Five minutes of orbits over one fire.
///
/// # Errors
/// [`SetupError`] when the rig is refused.
pub fn one_fire(rng: &mut ChaCha8Rng) -> Result<Incidents, SetupError> {
    let (gnss, ground) = drawn_sensors(rng);
    let slant_m = log_uniform(rng, 40.0, 150.0);
    let height_m = slant_m * rng.random_range(0.3..0.8);
    let mut course = Course::drawn(rng, Kind::Orbit, slant_m, height_m);
    course.duration_s = ORBIT_S;
    let errors = ErrorModel::of(gnss, 1.0);
    let times_s = course.looks((ORBIT_S * LOOKS_PER_S) as usize, 0.4);
    let watch = Watch {
        lens: lens(&course),
        errors,
        flames: vec![Flame {
            base_m: Vector3::zeros(),
            size_m: (LEAST_PX * 1.5 * slant_m / Lens::wide().focal_px).max(1.0),
        }],
        wandered: wander(rng, &errors, &times_s, Law::Assumed),
        times_s,
        course: &course,
    };
    let occluded = occlusions(rng);
    let mut pilot = Pilot::new(&watch.lens, &errors, ground.then(|| flat(rng)))?;
    let told = run(&watch, &mut pilot, rng, &occluded, FALSE_BOX);
    Ok(outcome(1, &told, &pilot, 0.0, false))
}

/// Two minutes of an orbit over two fires that are [`SIGMAS_APART`] apart: sigma is the bound's own
/// standard deviation of the difference of their positions, along the line that joins them, after
/// [`SIGMA_LOOKS`] looks and without any ground; but never nearer than a detector tells boxes apart.
///
/// # Errors
/// [`SetupError`] when the rig is refused.
pub fn two_fires(rng: &mut ChaCha8Rng) -> Result<Incidents, SetupError> {
    let (gnss, _) = drawn_sensors(rng);
    let slant_m = log_uniform(rng, 30.0, 100.0);
    let height_m = slant_m * rng.random_range(0.3..0.8);
    let mut course = Course::drawn(rng, Kind::Orbit, slant_m, height_m);
    course.duration_s = 120.0;
    let errors = ErrorModel::of(gnss, 1.0);
    let times_s = course.looks(240, 0.4);
    let lens = lens(&course);
    let size_m = LEAST_PX * slant_m / lens.focal_px;
    let bearing = rng.random_range(0.0..std::f64::consts::TAU);
    let along = Vector3::new(f64::sin(bearing), f64::cos(bearing), 0.0);
    let sigma_m = sigma_between(&course, &lens, &errors, &times_s, &along, size_m);
    let wanted_m = SIGMAS_APART * sigma_m.unwrap_or(0.0);
    let apart_m = wanted_m.max(1.5 * size_m);
    let flame = |sign: f64| Flame {
        base_m: along * (0.5 * sign * apart_m),
        size_m,
    };
    let watch = Watch {
        flames: vec![flame(1.0), flame(-1.0)],
        wandered: wander(rng, &errors, &times_s, Law::Assumed),
        course: &course,
        lens,
        errors,
        times_s,
    };
    let mut pilot = Pilot::new(&watch.lens, &errors, None)?;
    let told = run(&watch, &mut pilot, rng, &[], 0.0);
    Ok(outcome(2, &told, &pilot, apart_m, wanted_m >= apart_m))
}

fn drawn_sensors(rng: &mut ChaCha8Rng) -> (Gnss, bool) {
    (Gnss::ALL[rng.random_range(0..2)], rng.random_bool(0.5))
}

fn lens(course: &Course) -> Lens {
    Lens {
        depression_deg: course.mean_depression_deg(),
        ..Lens::wide()
    }
}

/// Flat ground whose height errs.
fn flat(rng: &mut ChaCha8Rng) -> super::estimator::Ground {
    let mut ground = ground_at_datum((0.0, 0.0), GROUND_SIGMA_M);
    ground.height_m += super::truth::gauss(rng, GROUND_SIGMA_M);
    ground
}

fn occlusions(rng: &mut ChaCha8Rng) -> Vec<std::ops::Range<f64>> {
    let mut one = || {
        let start = rng.random_range(10.0..ORBIT_S - 20.0);
        start..start + rng.random_range(OCCLUDED_S)
    };
    (0..OCCLUSIONS).map(|_| one()).collect()
}

fn sigma_between(
    course: &Course,
    lens: &Lens,
    errors: &ErrorModel,
    times_s: &[f64],
    along: &Vector3<f64>,
    size_m: f64,
) -> Option<f64> {
    let looks: Vec<BoundLook> = times_s
        .iter()
        .take(SIGMA_LOOKS)
        .map(|t_s| BoundLook {
            t_s: *t_s,
            state: course.state(*t_s),
            stereo: true,
        })
        .collect();
    // Far enough apart that the two are not one point, near enough to be seen alike.
    let flame = |sign: f64| Flame {
        base_m: along * sign,
        size_m,
    };
    let flames = [(flame(0.5), looks.clone()), (flame(-0.5), looks)];
    apart_sigma_m(&information(lens, errors, &flames)?, along)
}

fn run(
    watch: &Watch<'_>,
    pilot: &mut Pilot,
    rng: &mut ChaCha8Rng,
    occluded: &[std::ops::Range<f64>],
    false_box: f64,
) -> BTreeSet<u32> {
    let mut draws: Vec<Draw> = (0..watch.flames.len())
        .map(|_| Draw::new(stream(rng.random(), "boxes"), Law::Assumed))
        .collect();
    let mut told = BTreeSet::new();
    for (t_s, slow) in watch.times_s.iter().zip(&watch.wandered) {
        let hidden = occluded.iter().any(|range| range.contains(t_s));
        let mut seen = boxes(watch, *t_s, slow, &mut draws);
        seen.retain(|_| !rng.random_bool(MISS) && !hidden);
        if rng.random_bool(false_box) {
            seen.push(nothing(rng));
        }
        let autopilot = Autopilot::new(watch.course, *t_s, slow, &watch.errors, rng);
        pilot.look(&autopilot, &seen);
        let confirmed = pilot.fires().into_iter().filter(|fire| fire.confirmed);
        told.extend(confirmed.map(|fire| fire.id));
    }
    told
}

/// What the detector makes of the flames: nearer ones first, and one of two that overlap.
fn boxes(watch: &Watch<'_>, t_s: f64, slow: &Slow, draws: &mut [Draw]) -> Vec<Seen> {
    let state = watch.course.state(t_s);
    let camera = TrueCamera {
        lens: &watch.lens,
        state: &state,
        slow,
    };
    let mut seen: Vec<Seen> = watch
        .flames
        .iter()
        .zip(draws)
        .filter_map(|(flame, draw)| camera.see(flame, &watch.errors, draw))
        .collect();
    seen.sort_by(|a, b| b.size_px.0.total_cmp(&a.size_px.0));
    let mut kept: Vec<Seen> = Vec::new();
    for one in seen {
        if kept.iter().all(|other| iou(&one, other) < NMS_IOU) {
            kept.push(one);
        }
    }
    kept
}

fn iou(a: &Seen, b: &Seen) -> f64 {
    let across = |a: f64, aw: f64, b: f64, bw: f64| {
        ((a + aw / 2.0).min(b + bw / 2.0) - (a - aw / 2.0).max(b - bw / 2.0)).max(0.0)
    };
    let both = across(a.base_px.0, a.size_px.0, b.base_px.0, b.size_px.0)
        * across(a.base_px.1, a.size_px.1, b.base_px.1, b.size_px.1);
    both / (a.size_px.0 * a.size_px.1 + b.size_px.0 * b.size_px.1 - both)
}

fn nothing(rng: &mut ChaCha8Rng) -> Seen {
    let base_px = (
        rng.random_range(0.0..IMAGE_PX.0),
        rng.random_range(0.0..IMAGE_PX.1),
    );
    let size = rng.random_range(8.0..40.0);
    Seen {
        base_px,
        size_px: (size, size),
        disparity_px: rng.random_bool(0.5).then(|| rng.random_range(1.0..20.0)),
        centroid_px: (base_px.0, base_px.1 - 0.5 * size),
        glow: 1e4 * rng.random_range(0.5..1.5),
        picture: None,
    }
}

fn outcome(
    fires: usize,
    told: &BTreeSet<u32>,
    pilot: &Pilot,
    apart_m: f64,
    sigma_sets: bool,
) -> Incidents {
    let open = pilot.fires();
    Incidents {
        fires,
        told: told.len(),
        left: open.iter().filter(|fire| told.contains(&fire.id)).count(),
        apart_m,
        sigma_sets,
    }
}

/// Share of flights with as many incidents as fires: none told twice, none lost.
#[must_use]
pub fn share_right(flown: &[Incidents]) -> f64 {
    let right = |f: &&Incidents| f.told == f.fires && f.left == f.fires;
    flown.iter().filter(right).count() as f64 / flown.len().max(1) as f64
}
