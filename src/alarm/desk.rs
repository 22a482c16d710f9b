//! When a fire is told, and when told again.

use super::{Action, Advice, Alarm, AlarmProperties, Attention, FireId, FireState};
use super::{Area, Burning, SizeM, TrendProbability};
use crate::assess::extent::{Extent, Measured};
use crate::assess::trend::Course;
use crate::assess::watch::Assessment;
use crate::track::Fire;
use emberfix_frames::{
    Covariance, HeightAboveGround, MissionEnu, MslAltitude, ServiceTime, Wgs84, enu_offset,
};
use std::collections::{BTreeMap, BTreeSet};

/// Where a fire is on the Earth, as far as the alarm needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct Situation {
    /// Base of the fire.
    pub place: Wgs84,
    /// Above mean sea level.
    pub altitude: MslAltitude,
    /// Above the terrain model, where one is known.
    pub above_ground: Option<HeightAboveGround>,
    /// Which way to fly so that its ellipse shrinks most.
    pub advice: Option<Advice>,
    /// How it burns.
    pub assessment: Assessment,
    /// The burning ground, its corners on the Earth.
    pub area: Option<Area>,
    /// Reasons why the ellipse is wider than it could be.
    pub degraded: Vec<String>,
}

/// Decides which fires to tell, and writes their alarms.
///
/// A fire is told when it is confirmed. It is told again when its state changes, when it moved by
/// more than half of the CE90 that was told, when CE90 fell below 0.7 of what was told, when a channel
/// of its light was lost, and every [`REPEAT_S`] while it is still seen; except for changes of state
/// never more often than every [`LEAST_S`], so that a busy scene leaves the link to new fires. One that
/// an operator dismissed is told no more until an operator says otherwise.
#[derive(Debug)]
pub struct AlarmDesk {
    uav: String,
    told: BTreeMap<FireId, Told>,
    dismissed: BTreeSet<FireId>,
}

#[derive(Debug, Clone)]
struct Told {
    revision: u32,
    state: FireState,
    place: Wgs84,
    ce90_m: f64,
    captured_at: ServiceTime,
    /// Channels that did not serve then.
    lost: Vec<&'static str>,
}

/// Seconds after which a fire that is still seen is told again.
pub const REPEAT_S: f64 = 10.0;
/// Seconds between two revisions that only better the position.
pub const LEAST_S: f64 = 1.0;
/// Share of the told CE90 by which a position must move to be told again.
const MOVED: f64 = 0.5;
/// Share of the told CE90 below which a better one is told again.
const BETTER: f64 = 0.7;

impl AlarmDesk {
    /// Nothing told yet; `uav` names the aircraft in every alarm.
    #[must_use]
    pub fn new(uav: String) -> Self {
        Self {
            uav,
            told: BTreeMap::new(),
            dismissed: BTreeSet::new(),
        }
    }

    /// Takes in what an operator did; false when it is about another aircraft's alarm.
    pub fn note(&mut self, action: &Action) -> bool {
        let number = action
            .alarm
            .strip_prefix(&self.uav)
            .and_then(|rest| rest.strip_prefix('-'));
        let Some(fire) = number.and_then(|number| number.parse().ok()).map(FireId) else {
            return false;
        };
        match action.kind.attention() {
            Some(Attention::Dismissed) => {
                self.dismissed.insert(fire);
            }
            Some(Attention::Wanted | Attention::Seen) => {
                self.dismissed.remove(&fire);
            }
            None => {}
        }
        true
    }

    /// The alarms that are due. `situate` places a fire on the Earth; one that is nowhere on it is
    /// not told.
    pub fn due(
        &mut self,
        fires: &[Fire],
        mut situate: impl FnMut(&Fire) -> Option<Situation>,
    ) -> Vec<Alarm> {
        let mut due = Vec::new();
        for fire in fires.iter().filter(|fire| fire.is_confirmed()) {
            let never_told = !self.told.contains_key(&fire.id);
            let ended_untold = never_told && fire.state == FireState::Out;
            if ended_untold || self.dismissed.contains(&fire.id) {
                continue;
            }
            let Some(situation) = situate(fire) else {
                continue;
            };
            let covariance = fire.covariance();
            if self.is_due(fire, &situation, &covariance) {
                due.push(self.write(fire, situation, &covariance));
            }
        }
        due
    }

    /// Newest revision and state that were told of a fire that people want to hear of.
    #[must_use]
    pub fn told(&self, fire: FireId) -> Option<(u32, FireState)> {
        let told = self.told.get(&fire)?;
        (!self.dismissed.contains(&fire)).then_some((told.revision, told.state))
    }

    /// The id that a fire has in alarms.
    #[must_use]
    pub fn id(&self, fire: FireId) -> String {
        format!("{}-{}", self.uav, fire.0)
    }

    /// A sighting's Feature with the aircraft's name and the fire's id.
    #[must_use]
    pub fn signed(
        &self,
        fire: Option<FireId>,
        mut feature: serde_json::Value,
    ) -> serde_json::Value {
        feature["properties"]["uav"] = self.uav.clone().into();
        feature["properties"]["fire"] = fire.map(|fire| self.id(fire)).into();
        feature
    }

    fn is_due(
        &self,
        fire: &Fire,
        situation: &Situation,
        covariance: &Covariance<MissionEnu>,
    ) -> bool {
        let Some(told) = self.told.get(&fire.id) else {
            return true;
        };
        if told.state != state(fire, &situation.assessment) {
            return true;
        }
        let since_s = (fire.last_seen - told.captured_at).as_secs_f64();
        let moved_m = enu_offset(&told.place, &situation.place).xy().norm();
        let mut lost = situation.assessment.reasons.iter();
        let changed = moved_m > MOVED * told.ce90_m
            || covariance.ce90_m() < BETTER * told.ce90_m
            || lost.any(|reason| !told.lost.contains(reason));
        since_s >= REPEAT_S || (changed && since_s >= LEAST_S)
    }

    fn write(
        &mut self,
        fire: &Fire,
        situation: Situation,
        covariance: &Covariance<MissionEnu>,
    ) -> Alarm {
        let ce90_m = covariance.ce90_m();
        let revision = self.told.get(&fire.id).map_or(1, |told| told.revision + 1);
        let place = situation.place;
        self.told.insert(
            fire.id,
            Told {
                revision,
                state: state(fire, &situation.assessment),
                place,
                ce90_m,
                captured_at: fire.last_seen,
                lost: situation.assessment.reasons.clone(),
            },
        );
        Alarm {
            place,
            properties: AlarmProperties {
                id: self.id(fire.id),
                revision,
                uav: self.uav.clone(),
                class: fire.class,
                state: state(fire, &situation.assessment),
                confidence: fire.event.probability(),
                first_seen_at: fire.first_seen,
                captured_at: fire.last_seen,
                altitude_msl_m: situation.altitude.m(),
                height_above_ground_m: situation.above_ground.map(HeightAboveGround::m),
                ce90_m,
                le90_m: covariance.le90_m(),
                covariance_enu_m2: covariance.row_major(),
                methods: fire.methods(),
                sightings: fire.evidence.hits(),
                range_m: fire.range_m,
                size_m: size(&situation.assessment).map_or(fire.size_m, |(size, _)| Some(size)),
                trend: situation.assessment.trend.map(|trend| trend.slope.value),
                advice: situation.advice,
                burning: burning(&situation),
                degraded: situation.degraded,
            },
        }
    }
}

/// What the alarm says of a fire: a confirmed one grows, is steady or dies, once that is known.
fn state(fire: &Fire, assessment: &Assessment) -> FireState {
    match (fire.state, assessment.course()) {
        (FireState::Confirmed, Some(Course::Growing)) => FireState::Growing,
        (FireState::Confirmed, Some(Course::Steady)) => FireState::Steady,
        (FireState::Confirmed, Some(Course::Dying)) => FireState::Dying,
        (state, _) => state,
    }
}

/// Size and one sigma of it.
fn size(assessment: &Assessment) -> Option<(SizeM, SizeM)> {
    let extent = assessment.extent.as_ref()?;
    let of = |pick: fn(&Measured) -> f64| SizeM {
        width: pick(&extent.width_m),
        height: pick(&extent.height_m),
    };
    Some((of(|side| side.value), of(|side| side.sigma)))
}

fn burning(situation: &Situation) -> Burning {
    let assessment = &situation.assessment;
    let size = size(assessment);
    Burning {
        size_sigma_m: size.map(|(_, sigma)| sigma),
        size_class: assessment.extent.as_ref().map(Extent::class),
        trend_sigma: assessment.trend.map(|trend| trend.slope.sigma),
        trend_probability: assessment.trend.map(|trend| TrendProbability {
            growing: trend.growing,
            dying: trend.dying,
        }),
        intensity: assessment.intensity,
        intensity_history: assessment.history.clone(),
        area: situation.area.clone(),
        spread: assessment.extent.as_ref().and_then(|extent| extent.spread),
    }
}
