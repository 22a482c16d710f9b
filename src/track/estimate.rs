//! Position of one fire: its [`Block`] read off at the common mean, and what that rests on.

use super::block::{self, Block, Measurement, State, Told};
use super::common::Common;
use super::measure::{LocalGround, Look};
use crate::alarm::Method;
use crate::locate::{Fix, Lens, Sighting, Terrain, View};
use emberfix_frames::{Covariance, Matrix3, MissionEnu, ServiceTime, Vector3};
use nalgebra::Matrix2;
use std::collections::BTreeSet;

/// Where a fire is and how sure, and what that rests on.
#[derive(Debug, Clone)]
pub struct Estimate {
    block: Block,
    state: State,
    position_m: Vector3<f64>,
    covariance: Matrix3<f64>,
    /// When the covariance was last read off; it never grows while a fire is not seen.
    read_at: Option<ServiceTime>,
    reads: u32,
    methods: BTreeSet<Method>,
    first_sight: Vector3<f64>,
    first_at: ServiceTime,
    ground: Option<GroundTaken>,
}

/// Where, and at which error, the ground was last taken in.
#[derive(Debug, Clone, Copy, PartialEq)]
struct GroundTaken {
    ground: LocalGround,
    at: Vector3<f64>,
    sigma_m: f64,
}

/// A sighting linearised, and what it says of the common errors.
#[derive(Debug, Clone)]
pub struct Taken {
    /// Linearised.
    pub measurement: Measurement,
    /// What it says of the common errors.
    pub told: Told,
    ground: Option<GroundTaken>,
    has_disparity: bool,
}

/// Bearings further apart than this make a parallax, radians.
const PARALLAX_RAD: f64 = 0.05;
/// The ground is taken in anew when the horizontal error has become this much smaller..
const GROUND_AGAIN: f64 = 0.5;
/// .. or when the position has moved by this many of the errors that it was taken in with.
const GROUND_MOVED: f64 = 1.0;
/// Horizontal error over range beyond which the ground is not taken in: its plane could be anywhere.
const GROUND_REACH: f64 = 0.7;
/// Inverse depth before anything is known: 10 m, to infinity at one sigma, 1/m.
const INVERSE_DEPTH: (f64, f64) = (0.1, 0.1);
/// Times that a covariance is read off at every sighting.
const YOUNG_READS: u32 = 40;
/// Seconds after which it is read off again: when the fire is seen, and when it is not.
const READ_S: (f64, f64) = (0.3, 1.0);

impl Estimate {
    /// Nothing known but the pixel: inverse depth as unknown as it can be, or within what stereo
    /// leaves when it says that it would have seen anything nearer than `at_least_m`.
    #[must_use]
    pub fn unseen(sighting: &Sighting, lens: &Lens, terrain_sigma_m: f64, common: &Common) -> Self {
        let inverse_depth = match (sighting.at_least_m, sighting.disparity) {
            (Some(least), None) if least > 0.0 => (0.5 / least, 0.5 / least),
            _ => INVERSE_DEPTH,
        };
        let ray = lens.ray_enu(sighting.base);
        let block = Block::unseen(lens, &ray, inverse_depth, terrain_sigma_m, common);
        Self {
            block,
            state: State::zeros(),
            position_m: *lens.centre(),
            covariance: Matrix3::zeros(),
            read_at: None,
            reads: 0,
            methods: BTreeSet::new(),
            first_sight: ray,
            first_at: sighting.at,
            ground: None,
        }
    }

    /// Position in the mission plane, metres.
    #[must_use]
    pub fn position_m(&self) -> Vector3<f64> {
        self.position_m
    }

    /// Its coordinates at the common mean.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Its coordinates as a function of the common errors.
    #[must_use]
    pub fn block(&self) -> &Block {
        &self.block
    }

    /// Its coordinates as a function of the common errors.
    pub fn block_mut(&mut self) -> &mut Block {
        &mut self.block
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

    /// Follows what was learned of the common errors. The covariance is read off when the fire was
    /// just seen, and now and then otherwise or once it has settled: it only shrinks, so an older one is
    /// never too small.
    pub fn read_off(&mut self, common: &Common, now: ServiceTime, is_seen: bool) {
        self.state = self.block.state(common);
        self.position_m = self.block.chart().position(&self.state);
        let since_s = self
            .read_at
            .map_or(f64::INFINITY, |at| (now - at).as_secs_f64());
        let is_young = is_seen && self.reads < YOUNG_READS;
        let limit_s = if is_seen { READ_S.0 } else { READ_S.1 };
        if is_young || since_s >= limit_s {
            let common = common.covariance();
            self.covariance = self.block.position_covariance(&self.state, common);
            self.read_at = Some(now);
            self.reads = self.reads.saturating_add(1);
        }
    }

    /// Linearises a sighting about what is known now; nothing changes yet. A new fire is looked for
    /// about its first `fix`, if it has one.
    #[must_use]
    pub fn take(
        &self,
        sighting: &Sighting,
        lens: &Lens,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        common: &Common,
        fix: Option<&Fix>,
    ) -> Option<Taken> {
        let mut start = self.block.state(common);
        if let Some(fix) = fix {
            start[block::INVERSE_DEPTH] = 1.0 / fix.range_m;
        }
        let ground = self.ground_that_is_due(&start, view, terrain, fix);
        let look = Look {
            sighting,
            lens,
            up: *view.up(),
            ground: ground.map(|taken| taken.ground),
            flown_share: self.flown_share(lens, view, common),
        };
        let (measurement, at) = look.measure(&self.block, common, start)?;
        let told = self.block.tells(&measurement, &at, common)?;
        Some(Taken {
            measurement,
            told,
            ground,
            has_disparity: sighting.disparity.is_some(),
        })
    }

    fn flown_share(&self, lens: &Lens, view: &View<'_>, common: &Common) -> f64 {
        let since_s = (view.pose.at - self.first_at).as_secs_f64();
        let variances = view.priors().way_variances(view.sigmas(), since_s);
        let state = self.block.state(common);
        self.block.flown_share(&state, lens.centre(), &variances)
    }

    /// Takes in what was linearised, given the common mean that it was linearised at.
    pub fn learn(&mut self, taken: &Taken, mean: &nalgebra::DVector<f64>, camera: &Vector3<f64>) {
        self.block.learn(&taken.measurement, &taken.told, mean);
        if taken.has_disparity {
            self.methods.insert(Method::Stereo);
        }
        if let Some(ground) = taken.ground {
            self.methods.insert(Method::Terrain);
            self.ground = Some(ground);
        }
        let sight = self.position_m - camera;
        if self.read_at.is_some() && sight.angle(&self.first_sight) > PARALLAX_RAD {
            self.methods.insert(Method::Parallax);
        }
    }

    /// The ground counts when it was never taken in, and again when the position is much better known
    /// than then or is another one, and the plane that stood for it no longer does. Not with every
    /// look, since it is the same ground.
    fn ground_that_is_due(
        &self,
        start: &State,
        view: &View<'_>,
        terrain: Option<&dyn Terrain>,
        fix: Option<&Fix>,
    ) -> Option<GroundTaken> {
        let terrain = terrain?;
        let at = self.block.chart().position(start);
        let horizontal = match (fix, self.read_at) {
            (Some(fix), _) => horizontal(fix.covariance.m2()),
            (None, Some(_)) => horizontal(&self.covariance),
            (None, None) => return None,
        };
        let sigma_m = horizontal.trace().max(0.0).sqrt();
        if sigma_m > GROUND_REACH * (at - view.camera_enu).norm() {
            return None;
        }
        let is_news = self.ground.is_none_or(|taken| {
            let is_other = sigma_m < GROUND_AGAIN * taken.sigma_m
                || (at - taken.at).xy().norm() > GROUND_MOVED * taken.sigma_m;
            is_other && !taken.ground.holds_at(&at, view, terrain)
        });
        if !is_news {
            return None;
        }
        let ground = LocalGround::about(&at, &horizontal, view, terrain)?;
        Some(GroundTaken {
            ground,
            at,
            sigma_m,
        })
    }
}

fn horizontal(m2: &Matrix3<f64>) -> Matrix2<f64> {
    m2.fixed_view::<2, 2>(0, 0).into_owned()
}
