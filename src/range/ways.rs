//! The ways to a disparity behind one trait, each from the same [`Scene`].

use super::patch::Cutter;
use super::reach::Reach;
use super::scene::{Scene, Search};
use super::sgbm::SemiGlobal;
use super::{
    Disparity, Method, Methods, Miss, RangeConfig, RangeError, Ranger, Ranging, RawPair, Target,
    best, centroid, correlate, cross_spectral,
};
use emberfix_calib::Rig;

/// Ranges by one method.
pub(super) struct Ways {
    method: Method,
    semi_global: SemiGlobal,
    cutter: Cutter,
    search: Search,
    reach: Reach,
    config: RangeConfig,
}

/// Disparities below infinity's that are tried, so that noise there is not cut off on one side.
const BELOW_INFINITY_PX: i32 = 4;

impl Ways {
    pub fn new(method: Method, rig: &Rig, config: &RangeConfig) -> Result<Self, RangeError> {
        let infinity_px = rig.rectification().infinity_disparity_px();
        let least = infinity_px.floor() as i32 - BELOW_INFINITY_PX;
        let search = Search {
            least,
            greatest: least + config.num_disparities as i32 - 1,
        };
        Ok(Self {
            method,
            semi_global: SemiGlobal::new(search, config)?,
            cutter: Cutter::new(rig),
            search,
            reach: Reach::new(rig, config),
            config: config.clone(),
        })
    }

    fn find(&mut self, pair: &RawPair, target: &Target) -> Result<Ranging, Miss> {
        self.cutter.check(pair)?;
        let config = &self.config;
        let scene = Scene::new(&self.cutter, pair, target, self.search, config)?;
        let (found, used) = match self.method {
            Method::Best => best::find(&scene, config)?,
            method => {
                let matched = match method {
                    Method::Sgbm => self.semi_global.find(&scene)?,
                    Method::Centroid => centroid::find(&scene, config)?,
                    Method::CrossSpectral => cross_spectral::find(&scene, config)?,
                    Method::Correlate | Method::Best => correlate::find(&scene, config)?,
                };
                let found = Disparity {
                    sigma_px: scene.sigma(&matched).px(),
                    ..matched.found
                };
                (found, Methods::only(method))
            }
        };
        Ok(self.reach.judge(&found, used))
    }
}

impl Ranger for Ways {
    fn range(&mut self, pair: &RawPair, target: &Target) -> Result<Ranging, RangeError> {
        match self.find(pair, target) {
            Ok(ranging) => Ok(ranging),
            Err(Miss::Refused(why)) => Ok(Ranging::NoMatch { why }),
            Err(Miss::Failed(error)) => Err(error),
        }
    }
}
