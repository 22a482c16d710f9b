//! What the heights of the vehicle count from, and whether they can be believed.
//!
//! The autopilot's altitude is GNSS altitude above the receiver's geoid; ellipsoid height is that
//! plus the receiver's own separation. Autopilots fall back to bare barometric altitude (or to 0)
//! without saying so: held against the receiver's altitude, that shows.

use emberfix_frames::{Geoid, GeoidUndulation, Wgs84, Wgs84Parts};

/// Where an undulation comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Separation {
    /// The receiver says it.
    Receiver,
    /// The receiver says nothing: EGM96.
    Model,
    /// The receiver says something that no geoid model comes near: EGM96.
    ModelAgainstReceiver {
        /// By how much they differ, metres.
        by_m: f64,
    },
}

/// Heights so far.
#[derive(Debug, Default)]
pub(super) struct Heights {
    geoid: Geoid,
    first: Option<f64>,
    second: Option<f64>,
    watch: AltitudeWatch,
    not_estimated: bool,
}

/// Share of a new separation that is taken over: 5 Hz GNSS settles in 4 s.
const SEPARATION_GAIN: f64 = 0.05;
/// Receivers carry coarse geoid models, some metres off; further off it is no model at all.
const GEOID_LIMIT_M: f64 = 10.0;

impl Heights {
    /// The first receiver's ellipsoid height minus its altitude.
    pub(super) fn note_separation(&mut self, separation: GeoidUndulation) {
        self.first = Some(filtered(self.first, separation.m(), SEPARATION_GAIN));
    }

    /// The second receiver's; counts while the first says nothing.
    pub(super) fn note_second_separation(&mut self, separation: GeoidUndulation) {
        self.second = Some(filtered(self.second, separation.m(), SEPARATION_GAIN));
    }

    pub(super) fn note_altitudes(&mut self, autopilot_m: f64, receiver_m: f64) {
        self.watch.note(autopilot_m - receiver_m);
    }

    /// Whether the autopilot's estimator says that its own vertical position is valid.
    pub(super) fn note_estimated(&mut self, valid: bool) {
        self.not_estimated = !valid;
    }

    pub(super) fn is_estimated(&self) -> bool {
        !self.not_estimated
    }

    pub(super) fn watch(&self) -> &AltitudeWatch {
        &self.watch
    }

    pub(super) fn undulation(&self, place: &Wgs84) -> (GeoidUndulation, Separation) {
        let model = self
            .geoid
            .undulation(place.latitude_deg(), place.longitude_deg());
        match self.first.or(self.second) {
            None => (model, Separation::Model),
            Some(own) if (own - model.m()).abs() <= GEOID_LIMIT_M => {
                (GeoidUndulation::from_m(own), Separation::Receiver)
            }
            Some(own) => {
                let by_m = own - model.m();
                (model, Separation::ModelAgainstReceiver { by_m })
            }
        }
    }
}

/// The autopilot's altitude against the receiver's.
#[derive(Debug, Default)]
pub(super) struct AltitudeWatch {
    usual: Option<f64>,
    latest: f64,
    jumped: bool,
}

/// A change of the difference that no filter makes within one GNSS period, metres.
const JUMP_M: f64 = 6.0;
/// A difference that drift of a barometer or of GNSS alone does not explain, metres, and sigmas of
/// GNSS.
const DRIFT_M: f64 = 10.0;
const DRIFT_SIGMAS: f64 = 4.0;
/// Share of a new difference that the usual one takes over: 20 s at 5 Hz.
const GAIN: f64 = 0.01;
/// The same after a jump: until it has become usual (minutes), it is told.
const GAIN_AFTER_JUMP: f64 = 0.001;

impl AltitudeWatch {
    fn note(&mut self, difference_m: f64) {
        let usual = self.usual.unwrap_or(difference_m);
        self.jumped = (difference_m - usual).abs() > JUMP_M;
        let gain = if self.jumped { GAIN_AFTER_JUMP } else { GAIN };
        self.usual = Some(filtered(Some(usual), difference_m, gain));
        self.latest = difference_m;
    }

    /// By how much the two disagree, metres.
    pub(super) fn disagreement_m(&self) -> f64 {
        if self.jumped {
            self.latest.abs().max(JUMP_M)
        } else {
            self.usual.unwrap_or(0.0).abs()
        }
    }

    /// Whether that is more than GNSS of this sigma explains.
    pub(super) fn is_doubtful(&self, vertical_sigma_m: f64) -> bool {
        self.jumped || self.disagreement_m() > DRIFT_M.max(DRIFT_SIGMAS * vertical_sigma_m)
    }
}

fn filtered(old: Option<f64>, new: f64, gain: f64) -> f64 {
    old.map_or(new, |old| old + gain * (new - old))
}
