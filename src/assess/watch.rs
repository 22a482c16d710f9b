//! Each fire's assessment over time.
//!
//! **In:** the fires of a frame with their sightings, the view, the flame's light and the light of
//! the lines. **Out:** one [`Assessment`] per fire. Bound: as many as the tracker keeps; the rest is
//! forgotten with [`Assessor::keep`].

use super::extent::{Extent, Measured, Outline, Standing, Wind};
use super::fusion::{Fused, Fusion};
use super::outline::Look;
use super::trend::{Course, Trend, WINDOW_S};
use crate::alarm::FireId;
use crate::locate::{Sighting, View};
use crate::track::Fire;
use emberfix_frames::{Covariance, MissionEnu, ServiceTime, Vector3};
use std::collections::{BTreeMap, VecDeque};

/// What one look says of a fire's light, in units that do not depend on range.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Light {
    /// Flame in the image: area times red, of the scene's own level, at the image: pixels.
    pub visible: Option<f64>,
    /// Light of the lines at the instrument.
    pub spectral: Option<f64>,
}

/// All that is known of how one fire burns.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Assessment {
    /// Size, area, spread.
    pub extent: Option<Extent>,
    /// 1 when it was first assessed.
    pub intensity: Option<Measured>,
    /// How that changes.
    pub trend: Option<Trend>,
    /// Seconds before the latest look (negative) and intensity, in time order, thinned.
    pub history: Vec<[f64; 2]>,
    /// Channels that do not serve at the moment, by name.
    pub reasons: Vec<&'static str>,
}

impl Assessment {
    /// What it does, once that is known: a running front is growth, whatever the light does.
    #[must_use]
    pub fn course(&self) -> Option<Course> {
        let runs = self
            .extent
            .as_ref()
            .is_some_and(|extent| extent.spread.is_some());
        match self.trend.map(|trend| trend.course) {
            Some(Course::Dying) => Some(Course::Dying),
            _ if runs => Some(Course::Growing),
            course => course,
        }
    }
}

/// All fires' assessments.
#[derive(Debug, Default)]
pub struct Assessor {
    fires: BTreeMap<FireId, Watched>,
}

#[derive(Debug, Default)]
struct Watched {
    outline: Outline,
    fusion: Fusion,
    last: Option<(ServiceTime, Fused)>,
    history: VecDeque<Told>,
    course: Option<Course>,
    now: Assessment,
}

/// The fused intensity at a look.
#[derive(Debug, Clone, Copy)]
struct Told {
    at: ServiceTime,
    level: f64,
    range_m: f64,
}

/// Seconds without a look after which the rate is not known any more.
const GAP_S: f64 = 4.0;
/// Intensities that are kept: a minute of looks ten times a second.
const MOST_TOLD: usize = 600;
/// Seconds of history that are told, and how many points of it.
const HISTORY_S: f64 = 60.0;
const HISTORY_POINTS: usize = 24;
/// Seconds between two extents: they rest on many looks.
const EXTENT_EVERY_S: f64 = 0.5;
/// Range that is worse known than this makes no size.
const MOST_RANGE_SHARE: f64 = 0.5;
/// Seconds after which GNSS error has become another one.
const GNSS_S: f64 = 100.0;

impl Assessor {
    /// Takes one sighting of a fire in.
    pub fn note(
        &mut self,
        fire: &Fire,
        sighting: &Sighting,
        view: &View<'_>,
        light: Light,
        wind: Option<&Wind>,
    ) {
        let watched = self.fires.entry(fire.id).or_default();
        let position = fire.estimate.position_m();
        let standing = standing(&position, &fire.covariance(), view);
        watched.outline.add(Look::of(sighting, view));
        watched.take_light(sighting.at, light, (position - view.camera_enu).norm());
        watched.assess(sighting.at, &standing, wind);
    }

    /// The latest assessment of a fire.
    #[must_use]
    pub fn of(&self, fire: FireId) -> Option<&Assessment> {
        self.fires.get(&fire).map(|watched| &watched.now)
    }

    /// Which channels of which fires' light do not serve, for the operator; each once.
    #[must_use]
    pub fn warnings(&self) -> Vec<&'static str> {
        let faults = self.fires.values().filter_map(|watched| watched.last);
        let told = faults.flat_map(|(_, fused)| {
            let channels = super::fusion::Channel::ALL.into_iter().zip(fused.faults);
            channels.filter_map(|(channel, fault)| Some(fault?.words(channel)))
        });
        let words: std::collections::BTreeSet<&'static str> = told.collect();
        words.into_iter().collect()
    }

    /// Forgets the fires that are not kept.
    pub fn keep(&mut self, kept: impl Fn(FireId) -> bool) {
        self.fires.retain(|fire, _| kept(*fire));
    }
}

/// Error of the range: the position's along the line of sight, without what moves the camera alike.
fn standing(
    position: &Vector3<f64>,
    covariance: &Covariance<MissionEnu>,
    view: &View<'_>,
) -> Standing {
    let sight = position - view.camera_enu;
    let range_m = sight.norm().max(1e-3);
    let along = sight / range_m;
    let m2 = emberfix_frames::Matrix3::from_row_slice(&covariance.row_major());
    let gnss = Vector3::new(
        view.pose.gnss_horizontal_m,
        view.pose.gnss_horizontal_m,
        view.pose.gnss_vertical_m,
    );
    let camera_m2: f64 = gnss.component_mul(&along).norm_squared();
    let own_m2 = ((along.transpose() * m2 * along)[0] - camera_m2).max(1e-4 * range_m * range_m);
    let wander = |sigma: f64| sigma * (2.0 / GNSS_S).sqrt();
    Standing {
        foot: *position,
        range_share: own_m2.sqrt() / range_m,
        wander_m: (
            wander(view.pose.gnss_horizontal_m),
            wander(view.pose.gnss_vertical_m),
        ),
        turn_rad: (view.priors().heading_rad, view.priors().tilt_rad),
    }
}

impl Watched {
    fn take_light(&mut self, at: ServiceTime, light: Light, range_m: f64) {
        let dt_s = self.last.map_or(0.0, |(last, _)| (at - last).as_secs_f64());
        if dt_s > GAP_S {
            self.fusion.after_gap();
            self.history.clear();
        }
        // Light falls with the square of the range; metres, not pixels.
        let here = |light: f64| light * range_m * range_m;
        let samples = [light.spectral.map(here), light.visible.map(here)];
        let Some(fused) = self.fusion.step(dt_s.clamp(1e-3, GAP_S), samples) else {
            return;
        };
        self.last = Some((at, fused));
        self.history.push_back(Told {
            at,
            level: fused.level,
            range_m,
        });
        if self.history.len() > MOST_TOLD {
            self.history.pop_front();
        }
    }

    fn assess(&mut self, at: ServiceTime, standing: &Standing, wind: Option<&Wind>) {
        if standing.range_share > MOST_RANGE_SHARE {
            self.now.extent = None;
        } else if self.outline.is_due(at, EXTENT_EVERY_S) {
            self.now.extent = self.outline.extent(standing, wind);
        }
        let Some((_, fused)) = self.last else {
            return;
        };
        self.now.intensity = Some(Measured {
            value: fused.level,
            sigma: fused.level_sigma,
        });
        let channels = super::fusion::Channel::ALL.into_iter().zip(fused.faults);
        self.now.reasons = channels
            .filter_map(|(channel, fault)| Some(fault?.reason(channel)))
            .collect();
        self.now.trend = self.trend(at, standing);
        self.course = self.now.trend.map(|trend| trend.course);
        self.now.history = self.thinned(at);
    }

    fn trend(&self, at: ServiceTime, standing: &Standing) -> Option<Trend> {
        let since = |told: &Told| (told.at - at).as_secs_f64();
        let recent: Vec<&Told> = self
            .history
            .iter()
            .filter(|told| since(told) >= -WINDOW_S)
            .collect();
        let (first, last) = (recent.first()?, recent.last()?);
        let span_s = (last.at - first.at).as_secs_f64().max(1e-3);
        // A range wrong by a share makes light wrong by twice that, and by another amount when
        // the range is another one.
        let nearer = (last.range_m / first.range_m).ln().abs();
        let drift = 2.0 * standing.range_share * nearer / span_s;
        let samples: Vec<(f64, f64)> = recent
            .iter()
            .map(|told| (since(told), told.level))
            .collect();
        Trend::of(&samples, drift, self.course)
    }

    fn thinned(&self, at: ServiceTime) -> Vec<[f64; 2]> {
        let since = |told: &Told| (told.at - at).as_secs_f64();
        let recent: Vec<[f64; 2]> = self
            .history
            .iter()
            .map(|told| [since(told), told.level])
            .filter(|point| point[0] >= -HISTORY_S)
            .collect();
        let step = recent.len().div_ceil(HISTORY_POINTS).max(1);
        // Counted from the newest, so that the newest is always among them.
        let mut thinned: Vec<[f64; 2]> = recent.into_iter().rev().step_by(step).collect();
        thinned.reverse();
        thinned
    }
}
