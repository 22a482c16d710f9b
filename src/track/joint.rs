//! The joint estimate: the errors that all fires share, and every fire's position.
//!
//! State: [`SHARED`] shared errors, each in units of its own prior sigma (so that a sigma that
//! changes in flight needs no bookkeeping), then four numbers per fire: east, north, up of its base
//! in the mission plane, and by how much the ground there is above the terrain model; metres.
//!
//! Source: the extended Kalman filter with nuisance states, Bar-Shalom, Li, Kirubarajan,
//! "Estimation with Applications to Tracking and Navigation" (2001), 10.3. Shared errors wander as
//! first-order Gauss-Markov processes: what was learned fades back to the prior, so no error is
//! ever known for good. One dense covariance keeps what the wandering does to all fires alike; a
//! form that calls fires independent given the shared errors does not, and its ellipses shrink.
//!
//! **Bound.** Cost of one sighting is quadratic in the fires that are kept: [`MAX_FIRES`] at most.

use super::TrackConfig;
use crate::locate::{SHARED, Shared};
use nalgebra::{DMatrix, DVector, SMatrix, SVector};

/// Numbers per fire.
pub const PER_FIRE: usize = 4;
/// Shared errors and one fire: what one sighting speaks of.
pub const LOCAL: usize = SHARED + PER_FIRE;
/// Fires at most; the tracker forgets the weakest beyond.
pub const MAX_FIRES: usize = 128;

/// Mean and covariance of everything.
#[derive(Debug, Clone)]
pub struct Joint {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl Default for Joint {
    fn default() -> Self {
        Self {
            mean: DVector::zeros(SHARED),
            covariance: DMatrix::identity(SHARED, SHARED),
        }
    }
}

impl Joint {
    /// Lets `dt_s` pass: shared errors fade towards their priors, fires stay.
    pub fn age(&mut self, dt_s: f64, config: &TrackConfig) {
        for (index, correlation_s) in correlations(config).iter().enumerate() {
            let keep = (-dt_s.max(0.0) / correlation_s).exp();
            self.mean[index] *= keep;
            self.covariance.row_mut(index).scale_mut(keep);
            self.covariance.column_mut(index).scale_mut(keep);
            self.covariance[(index, index)] += 1.0 - keep * keep;
        }
    }

    /// Adds a fire `f = at + by_shared n + e` with `e ~ N(0, own)`; its slot is the next one.
    pub fn add(
        &mut self,
        at: &SVector<f64, PER_FIRE>,
        by_shared: &SMatrix<f64, PER_FIRE, SHARED>,
        own: &SMatrix<f64, PER_FIRE, PER_FIRE>,
    ) {
        let old = self.mean.len();
        let with_all = by_shared * self.covariance.rows(0, SHARED);
        let itself = with_all.columns(0, SHARED) * by_shared.transpose() + own;
        let mean = at + by_shared * self.mean.rows(0, SHARED);
        self.mean.resize_vertically_mut(old + PER_FIRE, 0.0);
        self.mean.rows_mut(old, PER_FIRE).copy_from(&mean);
        self.covariance
            .resize_mut(old + PER_FIRE, old + PER_FIRE, 0.0);
        self.covariance
            .view_mut((old, 0), (PER_FIRE, old))
            .copy_from(&with_all);
        self.covariance
            .view_mut((0, old), (old, PER_FIRE))
            .copy_from(&with_all.transpose());
        self.covariance
            .view_mut((old, old), (PER_FIRE, PER_FIRE))
            .copy_from(&itself);
    }

    /// Forgets the fire in a slot; later fires move up by one.
    pub fn remove(&mut self, slot: usize) {
        let mean = std::mem::replace(&mut self.mean, DVector::zeros(0));
        let covariance = std::mem::replace(&mut self.covariance, DMatrix::zeros(0, 0));
        self.mean = mean.remove_rows(offset(slot), PER_FIRE);
        self.covariance = covariance
            .remove_rows(offset(slot), PER_FIRE)
            .remove_columns(offset(slot), PER_FIRE);
    }

    /// Takes in a measurement `residual = by_local (n, f) + noise` about the shared errors and the
    /// fire in `slot`, where `residual` is what is left at the present mean. A measurement that
    /// numbers can't take in is left out.
    pub fn update<const M: usize>(
        &mut self,
        slot: usize,
        residual: &SVector<f64, M>,
        by_local: &SMatrix<f64, M, LOCAL>,
        noise: &SMatrix<f64, M, M>,
    ) {
        let spread = by_local * self.local(slot) * by_local.transpose() + noise;
        let Some(inverse) = spread.try_inverse() else {
            return;
        };
        let of_shared = by_local.fixed_columns::<SHARED>(0).transpose();
        let of_fire = by_local.fixed_columns::<PER_FIRE>(SHARED).transpose();
        let lever = self.covariance.columns(0, SHARED) * of_shared
            + self.covariance.columns(offset(slot), PER_FIRE) * of_fire;
        let gain = &lever * inverse;
        self.mean += &gain * residual;
        self.covariance.gemm(-1.0, &gain, &lever.transpose(), 1.0);
        let mirrored = self.covariance.transpose();
        self.covariance += mirrored;
        self.covariance *= 0.5;
    }

    /// Best guess of the shared errors, sigmas.
    #[must_use]
    pub fn shared(&self) -> SVector<f64, SHARED> {
        self.mean.fixed_rows::<SHARED>(0).into_owned()
    }

    /// Covariance of the shared errors, sigmas squared.
    #[must_use]
    pub fn shared_covariance(&self) -> SMatrix<f64, SHARED, SHARED> {
        self.covariance
            .fixed_view::<SHARED, SHARED>(0, 0)
            .into_owned()
    }

    /// Mean of the fire in a slot.
    #[must_use]
    pub fn fire(&self, slot: usize) -> SVector<f64, PER_FIRE> {
        self.mean.fixed_rows::<PER_FIRE>(offset(slot)).into_owned()
    }

    /// Covariance between the fires in two slots (of one fire, when they are the same).
    #[must_use]
    pub fn between(&self, a: usize, b: usize) -> SMatrix<f64, PER_FIRE, PER_FIRE> {
        self.covariance
            .fixed_view::<PER_FIRE, PER_FIRE>(offset(a), offset(b))
            .into_owned()
    }

    /// Covariance of (shared errors, the fire in a slot).
    #[must_use]
    pub fn local(&self, slot: usize) -> SMatrix<f64, LOCAL, LOCAL> {
        let mut local = SMatrix::<f64, LOCAL, LOCAL>::zeros();
        let with_shared = self
            .covariance
            .fixed_view::<PER_FIRE, SHARED>(offset(slot), 0)
            .into_owned();
        local
            .fixed_view_mut::<SHARED, SHARED>(0, 0)
            .copy_from(&self.shared_covariance());
        local
            .fixed_view_mut::<PER_FIRE, SHARED>(SHARED, 0)
            .copy_from(&with_shared);
        local
            .fixed_view_mut::<SHARED, PER_FIRE>(0, SHARED)
            .copy_from(&with_shared.transpose());
        local
            .fixed_view_mut::<PER_FIRE, PER_FIRE>(SHARED, SHARED)
            .copy_from(&self.between(slot, slot));
        local
    }
}

fn offset(slot: usize) -> usize {
    SHARED + PER_FIRE * slot
}

/// Correlation time of each shared error, seconds.
fn correlations(config: &TrackConfig) -> [f64; SHARED] {
    let mut seconds = [config.mount_correlation_s; SHARED];
    for axis in 0..3 {
        seconds[Shared::GnssEast as usize + axis] = config.gnss_correlation_s;
    }
    seconds[Shared::Heading as usize] = config.heading_correlation_s;
    seconds
}
