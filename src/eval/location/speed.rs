//! What a frame costs when very much burns.
//!
//! Each sighting has its picture, as in flight. What is in it is drawn cell by cell: to compare two pictures
//! costs the same whatever they show.

use super::estimator::{Pilot, SetupError};
use super::flight::{Course, Gusts, Kind};
use super::law::{Draw, Law};
use super::truth::{Autopilot, ErrorModel, Flame, Gnss, IMAGE_PX, Lens, Seen, Slow, TrueCamera};
use crate::assess::patch::Patch;
use emberfix_sim::noise::stream;
use nalgebra::{Matrix3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rustix::time::{ClockId, clock_gettime};

/// Looks before the clock runs, and looks that are timed.
const WARM: usize = 3;
const TIMED: usize = 7;

/// A crowd of fires under a camera that hovers: all are seen in each look.
pub struct Crowd {
    lens: Lens,
    errors: ErrorModel,
    course: Course,
    flames: Vec<Flame>,
    boxes: Draw,
    jitter: ChaCha8Rng,
    pilot: Pilot,
    looks: u32,
}

/// One look of a crowd, drawn and not yet taken in.
pub struct CrowdLook {
    seen: Vec<Seen>,
    t_s: f64,
}

/// Seconds between two looks.
const LOOK_S: f64 = 0.4;

impl Crowd {
    /// So many fires; nothing is seen yet.
    ///
    /// # Errors
    /// [`SetupError`] when the rig is refused.
    pub fn new(count: usize, seed: u64) -> Result<Self, SetupError> {
        let errors = ErrorModel::of(Gnss::Rtk, 0.5);
        let lens = Lens {
            depression_deg: 60.0,
            ..Lens::wide()
        };
        let course = Course {
            kind: Kind::Hover,
            ground_range_m: 60.0,
            height_m: 100.0,
            speed_m_s: 0.0,
            azimuth_rad: 0.0,
            duration_s: 10.0,
            gusts: Gusts::calm(),
        };
        Ok(Self {
            flames: spread(&course, &lens, count),
            boxes: Draw::new(stream(seed, "boxes"), Law::Assumed),
            jitter: stream(seed, "speed"),
            pilot: Pilot::new(&lens, &errors, None)?,
            lens,
            errors,
            course,
            looks: 0,
        })
    }

    /// What the next look shows.
    pub fn draw(&mut self) -> CrowdLook {
        let t_s = LOOK_S * f64::from(self.looks);
        self.looks += 1;
        let camera = TrueCamera {
            lens: &self.lens,
            state: &self.course.state(t_s),
            slow: &Slow::zeros(),
        };
        let flames = self.flames.iter();
        let seen = flames
            .filter_map(|flame| camera.see(flame, &self.errors, &mut self.boxes))
            .map(|seen| Seen {
                picture: Some(Patch(std::array::from_fn(|_| self.jitter.random()))),
                ..seen
            })
            .collect();
        CrowdLook { seen, t_s }
    }

    /// Takes a look in: what a frame costs.
    pub fn take(&mut self, look: &CrowdLook) {
        let (slow, rng) = (Slow::zeros(), &mut self.jitter);
        let autopilot = Autopilot::new(&self.course, look.t_s, &slow, &self.errors, rng);
        self.pilot.look(&autopilot, &look.seen);
    }
}

/// Milliseconds of one core per frame, the middle of seven, with `count` fires in the picture that
/// are all seen in each look, on one thread; and how many fires the estimator then keeps.
///
/// # Errors
/// [`SetupError`] when the rig is refused.
pub fn step_ms(count: usize, seed: u64) -> Result<(f64, usize), SetupError> {
    let mut crowd = Crowd::new(count, seed)?;
    let mut times_ms = Vec::new();
    for look in 0..WARM + TIMED {
        let seen = crowd.draw();
        let start_ms = thread_ms();
        crowd.take(&seen);
        if look >= WARM {
            times_ms.push(thread_ms() - start_ms);
        }
    }
    Ok((
        super::score::percentile(&mut times_ms, 0.5),
        crowd.pilot.open_fires(),
    ))
}

/// What this thread has computed so far: other work on the machine does not count.
fn thread_ms() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    1e3 * time.tv_sec as f64 + 1e-6 * time.tv_nsec as f64
}

/// Flames on flat ground, in a grid over the picture.
fn spread(course: &Course, lens: &Lens, count: usize) -> Vec<Flame> {
    let state = course.state(0.0);
    let columns = (count as f64 * IMAGE_PX.0 / IMAGE_PX.1).sqrt().ceil();
    let rows = (count as f64 / columns).ceil();
    let (sin, cos) = lens.depression_deg.to_radians().sin_cos();
    #[rustfmt::skip]
    let body_from_cam = Matrix3::new(
        0.0, -sin, cos,
        1.0, 0.0, 0.0,
        0.0, cos, sin,
    );
    let ground_at = |index: usize| {
        let index = index as f64;
        let (column, row) = (index % columns, (index / columns).floor());
        let u = IMAGE_PX.0 * ((column + 0.5) / columns - 0.5) / lens.focal_px;
        let v = IMAGE_PX.1 * ((row + 0.5) / rows - 0.5) / lens.focal_px;
        let ray = state.enu_from_body * body_from_cam * Vector3::new(u, v, 1.0);
        state.position_m + ray * (-state.position_m.z / ray.z)
    };
    (0..count)
        .map(|index| Flame {
            base_m: ground_at(index),
            size_m: 0.5,
        })
        .collect()
}
