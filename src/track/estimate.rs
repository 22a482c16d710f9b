//! Position of one fire with the errors that it was seen through, and what that rests on.

use super::chart::{Chart, INVERSE_DEPTH, OF_FIRE, State, TANGENTS};
use super::ground::LocalGround;
use super::joint::{JOINT, Joint, JointVector, Known, LASTING, Measured, Pace, Scatter};
use super::look::{Look, new_in_frame, rows};
use super::odometer::{Flown, Reading};
use super::window::{About, CLOCK, Kept, Window};
use crate::alarm::Method;
use crate::locate::{Distant, Fix, Lens, Predicted, SHARED, Shot, Sighting, Terrain, View};
use emberfix_frames::{Covariance, Matrix3, MissionEnu, Vector3};
use nalgebra::{Matrix2, SMatrix};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Where a fire is and how sure, and what that rests on.
#[derive(Debug, Clone)]
pub struct Estimate {
    chart: Chart,
    window: Window,
    /// Apart from the rest, which every frame looks at: thousands of fires stay close in memory.
    joint: Box<Joint>,
    /// When the errors in `joint` are those.
    at: Reading,
    position_m: Vector3<f64>,
    covariance: Matrix3<f64>,
    methods: BTreeSet<Method>,
    first_sight: Vector3<f64>,
    first: Reading,
    /// The camera at the first look, as reported.
    first_camera: Vector3<f64>,
    /// What of the reported way since then was surely flown.
    flown: Flown,
    /// Looks since it was last solved, and looks that it was solved from.
    unsolved: usize,
    solved: usize,
    /// Where it was linearised.
    solved_at: State,
}

/// One frame as the fires share it.
#[derive(Clone, Copy)]
pub struct Frame<'a> {
    /// Everything as reported.
    pub view: &'a View<'a>,
    /// The shutter, to be kept.
    pub shot: &'a Arc<Shot>,
    /// The camera as far as all fires together know it.
    pub lens: &'a Lens,
    /// The errors that the lens was made with.
    pub known: &'a Known,
    /// The odometer.
    pub reading: &'a Reading,
    /// How errors change.
    pub pace: &'a Pace,
    /// How much more noise there is than was said.
    pub scatter: Scatter,
    /// The ground.
    pub terrain: Option<&'a dyn Terrain>,
}

/// A fire as the camera should see it.
#[derive(Debug, Clone, Copy)]
pub struct Seen {
    /// Column, row, disparity.
    pub value: Vector3<f64>,
    /// Their covariance but for what is new in each frame.
    pub spread: Matrix3<f64>,
    /// Of what is new in each frame.
    pub new: Matrix3<f64>,
    /// Its base by the frame's lens alone, and the disparity that the fire's own errors add to what that says.
    pub base: Distant,
    pub disparity_apart_px: f64,
}

/// Bearings further apart than this make a parallax, radians.
const PARALLAX_RAD: f64 = 0.05;
/// Horizontal error over range beyond which the ground is not taken in: its plane could be anywhere.
const GROUND_REACH: f64 = 0.7;
/// Inverse depth before anything is known, 1/m: 100 m, its one sigma from 17 m to infinity. What has no
/// range from stereo or the ground is far, and looked for where far things stay in the image.
const INVERSE_DEPTH_PRIOR: (f64, f64) = (0.01, 0.05);
/// A fire with so few looks is solved at each..
const YOUNG: usize = 16;
/// .. and later when this share of its looks is new, or when it has moved along its line of sight by
/// this share of the range, or across it by this angle (radians), since.
const NEW_SHARE: f64 = 0.2;
const MOVED_SHARE: f64 = 0.02;
const MOVED_RAD: f64 = 0.01;

impl Estimate {
    /// A fire that was seen once; `None` when the sighting makes no sense.
    ///
    /// Its inverse depth is as unknown as it can be, or within what stereo leaves when it says that
    /// it would have seen anything nearer.
    #[must_use]
    pub fn begin(sighting: &Sighting, frame: &Frame<'_>, fix: Option<&Fix>) -> Option<Self> {
        let ray = frame.lens.ray_enu(sighting.base);
        let inverse_depth = match (sighting.at_least_m, sighting.disparity) {
            (Some(least), None) if least > 0.0 => (0.5 / least, 0.5 / least),
            _ => INVERSE_DEPTH_PRIOR,
        };
        let place = fix.map_or(&frame.view.pose.place, |fix| &fix.place);
        let terrain_sigma_m = frame.terrain.map_or(0.0, |terrain| terrain.sigma_m(place));
        let joint = Joint::unseen(frame.known, frame.lens, inverse_depth, terrain_sigma_m);
        let now = *frame.reading;
        let mut estimate = Self {
            chart: Chart::along(frame.lens, &frame.known.all(), &ray),
            window: Window::new(joint.clone(), now),
            solved_at: joint.fire(),
            joint: Box::new(joint),
            at: now,
            position_m: *frame.lens.centre(),
            covariance: Matrix3::zeros(),
            methods: BTreeSet::new(),
            first_sight: ray,
            first: now,
            first_camera: frame.view.camera_enu,
            flown: Flown::default(),
            unsolved: 0,
            solved: 0,
        };
        let mut start = *estimate.joint.mean();
        if let Some(fix) = fix {
            start[INVERSE_DEPTH] = 1.0 / fix.range_m;
        }
        let state: State = start.fixed_rows::<OF_FIRE>(0).into_owned();
        estimate.measure(sighting, frame, &start)?;
        estimate.position_m = estimate.chart.position(&state);
        let ground =
            fix.and_then(|fix| estimate.ground(frame, &start, &horizontal(fix.covariance.m2())));
        estimate.keep(sighting, frame);
        estimate.solve_about(&start, frame, ground.as_ref());
        Some(estimate)
    }

    /// Position in the mission plane, metres.
    #[must_use]
    pub fn position_m(&self) -> Vector3<f64> {
        self.position_m
    }

    /// The fire with the errors that it was seen through.
    #[must_use]
    pub fn joint(&self) -> &Joint {
        &self.joint
    }

    /// What its numbers mean.
    #[must_use]
    pub fn chart(&self) -> &Chart {
        &self.chart
    }

    /// Covariance of the position.
    #[must_use]
    pub fn covariance(&self) -> Covariance<MissionEnu> {
        // Non-negative by construction; rounding may leave a trace below zero, which reads as zero.
        Covariance::new(self.covariance).unwrap_or_else(|_| {
            let eigen = self.covariance.symmetric_eigen();
            let kept = Matrix3::from_diagonal(&eigen.eigenvalues.map(|v| v.max(0.0)));
            let m2 = eigen.eigenvectors * kept * eigen.eigenvectors.transpose();
            Covariance::new((m2 + m2.transpose()) * 0.5).unwrap_or_else(|_| Covariance::zero())
        })
    }

    /// What it rests on, sorted.
    #[must_use]
    pub fn methods(&self) -> Vec<Method> {
        self.methods.iter().copied().collect()
    }

    /// Where it should be seen, if the camera is what all fires together know; `None` behind it.
    #[must_use]
    pub fn predict(&self, lens: &Lens) -> Option<Predicted> {
        let (point, _, _) = self.chart.distant(&self.joint.fire());
        lens.predict(&point)
    }

    /// Lets the errors change, and the camera move on, up to a frame.
    pub fn age(&mut self, frame: &Frame<'_>) {
        self.joint.age(&self.at, frame.reading, frame.pace);
        self.at = *frame.reading;
        let since_s = (frame.reading.at - self.first.at).as_secs_f64();
        let by_itself = frame.pace.receiver_variances(since_s);
        let (strayed_m, variances) = frame.reading.strayed_since(&self.first, &by_itself);
        let way = frame.view.camera_enu - self.first_camera - strayed_m;
        self.flown = Flown {
            strayed_m,
            share: self.chart.flown_share(&way, &variances),
        };
    }

    /// Where it should be seen by what it knows of the errors itself, as of now.
    #[must_use]
    pub fn seen(&self, frame: &Frame<'_>) -> Option<Seen> {
        let state = self.joint.fire();
        let (point, _, _) = self.chart.distant(&state);
        let linear = frame.lens.linear(&point)?;
        let way = self.chart.way(frame.lens, &frame.known.all()) - self.flown.strayed_m;
        let by_state = self.chart.slopes(&linear, &state, frame.lens, &way);
        let rows = rows(&by_state, &linear.by_shared);
        let apart = rows * (self.joint.mean() - self.point(frame));
        Some(Seen {
            value: linear.value + apart,
            spread: rows * self.joint.covariance() * rows.transpose(),
            new: new_in_frame(&linear.by_shared) * frame.scatter.variance(),
            base: point,
            disparity_apart_px: apart.z,
        })
    }

    /// Takes a sighting in, linearised at what is known now. [`Estimate::solve`] does better.
    ///
    /// Returns its squared distance from where it should be over its numbers: 1 on average.
    pub fn take(&mut self, sighting: &Sighting, frame: &Frame<'_>) -> Option<f64> {
        let at = self.point(frame);
        let squared = self.measure(sighting, frame, &at).and_then(|mut measured| {
            measured.noise *= frame.scatter.variance();
            self.joint.take(&measured, &at)
        });
        self.joint.hold(at[INVERSE_DEPTH]);
        self.keep(sighting, frame);
        self.read_off();
        squared
    }

    /// How much it is to be solved again: looks that are new over looks that were solved; from one on
    /// it is due.
    #[must_use]
    pub fn need(&self) -> f64 {
        let news = self.unsolved as f64;
        if self.unsolved == 0 {
            return 0.0;
        }
        if self.solved < YOUNG {
            return 1.0 + news / self.solved.max(1) as f64;
        }
        let (now, then) = (self.joint.fire(), self.solved_at);
        let along = (now[INVERSE_DEPTH] / then[INVERSE_DEPTH] - 1.0).abs() / MOVED_SHARE;
        let across = (now - then).fixed_rows::<2>(TANGENTS).norm() / MOVED_RAD;
        (news / (NEW_SHARE * self.solved as f64))
            .max(along)
            .max(across)
    }

    /// Looks that solving it takes.
    #[must_use]
    pub fn looks(&self) -> usize {
        self.window.count()
    }

    /// Solves it from all looks that are kept, as of the latest of them.
    pub fn solve(&mut self, frame: &Frame<'_>) {
        let at = *self.joint.mean();
        let ground = self.ground(frame, &at, &horizontal(&self.covariance));
        self.solve_about(&at, frame, ground.as_ref());
    }

    fn solve_about(&mut self, at: &JointVector, frame: &Frame<'_>, ground: Option<&LocalGround>) {
        let about = About {
            at,
            when: &self.at,
            clock_sigma: self.joint.sigma(CLOCK),
            scatter: frame.scatter,
        };
        let (joint, when) = self.window.solve(&self.chart, &about, frame.pace, ground);
        (*self.joint, self.at) = (joint, when);
        self.joint.hold(at[INVERSE_DEPTH]);
        if ground.is_some() {
            self.methods.insert(Method::Terrain);
        }
        self.unsolved = 0;
        self.solved = self.window.count();
        self.solved_at = self.joint.fire();
        self.read_off();
    }

    /// Fire as known here, errors as the lens of the frame has them.
    fn point(&self, frame: &Frame<'_>) -> JointVector {
        let mut point = *self.joint.mean();
        point
            .fixed_rows_mut::<LASTING>(OF_FIRE)
            .copy_from(&frame.known.mean);
        point
    }

    fn measure(
        &self,
        sighting: &Sighting,
        frame: &Frame<'_>,
        at: &JointVector,
    ) -> Option<Measured> {
        self.look(sighting, frame).measure(&self.chart, at)
    }

    fn look<'a>(&'a self, sighting: &'a Sighting, frame: &Frame<'a>) -> Look<'a> {
        Look {
            sighting,
            lens: frame.lens,
            up: frame.view.up(),
            flown: &self.flown,
        }
    }

    fn keep(&mut self, sighting: &Sighting, frame: &Frame<'_>) {
        let kept = Kept {
            shot: Arc::clone(frame.shot),
            sighting: *sighting,
            reading: *frame.reading,
            flown: self.flown,
        };
        self.window.add(kept);
        if self.window.is_over() {
            self.fold(frame);
        }
        self.unsolved += 1;
        if sighting.disparity.is_some() {
            self.methods.insert(Method::Stereo);
        }
        let sight = self.position_m - frame.lens.centre();
        if sight.angle(&self.first_sight) > PARALLAX_RAD {
            self.methods.insert(Method::Parallax);
        }
    }

    fn fold(&mut self, frame: &Frame<'_>) {
        let at = *self.joint.mean();
        let ground = self.ground(frame, &at, &horizontal(&self.covariance));
        let about = About {
            at: &at,
            when: &self.at,
            clock_sigma: self.joint.sigma(CLOCK),
            scatter: frame.scatter,
        };
        self.window
            .fold(&self.chart, &about, frame.pace, ground.as_ref());
    }

    fn read_off(&mut self) {
        let state = self.joint.fire();
        self.position_m = self.chart.position(&state);
        let slope = self.chart.position_by_state(&state);
        let fire = self.joint.covariance().fixed_view::<OF_FIRE, OF_FIRE>(0, 0);
        let m2 = slope * fire * slope.transpose();
        self.covariance = (m2 + m2.transpose()) * 0.5;
    }

    /// The ground about the fire, unless that could be anywhere or was folded away with old looks.
    fn ground(
        &self,
        frame: &Frame<'_>,
        at: &JointVector,
        horizontal: &Matrix2<f64>,
    ) -> Option<LocalGround> {
        let terrain = frame.terrain.filter(|_| self.window.wants_ground())?;
        let state: State = at.fixed_rows::<OF_FIRE>(0).into_owned();
        let place = self.chart.position(&state);
        let sigma_m = horizontal.trace().max(0.0).sqrt();
        if sigma_m > GROUND_REACH * (place - frame.view.camera_enu).norm() {
            return None;
        }
        LocalGround::about(&place, horizontal, frame.view, terrain)
    }

    /// Rows over [`JOINT`] of the position.
    #[must_use]
    pub fn position_rows(&self) -> SMatrix<f64, 3, JOINT> {
        let slope = self.chart.position_by_state(&self.joint.fire());
        rows(&slope, &SMatrix::<f64, 3, SHARED>::zeros())
    }
}

fn horizontal(m2: &Matrix3<f64>) -> Matrix2<f64> {
    m2.fixed_view::<2, 2>(0, 0).into_owned()
}
