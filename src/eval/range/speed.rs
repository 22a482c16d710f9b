//! Time per fire and per frame, against the whole frame matched, on one thread in one run.
//!
//! Time is the thread's own time on the processor: on a machine that has nothing else to do it is the
//! time that passes, and on any other one it does not count what the others do.

use super::outcome::config;
use super::papers::FullFrame;
use super::stage::{Recipe, RigName, SeedSet, Stage};
use super::stats::{mean, median};
use super::{Options, RangeEvalError, Tick};
use crate::range::{Method, Ranger, RawPair, Target, open};
use emberfix_sim::world::World;
use rustix::time::{ClockId, clock_gettime};
use std::hint::black_box;
use std::sync::Arc;
use std::time::Duration;

/// Fires in the frame that has many.
pub(super) const MANY: usize = 16;
/// Interleaved measurements of both.
const PAIRS: usize = 9;

/// Times of one method.
#[derive(Debug, Clone, serde::Serialize)]
pub(super) struct Speed {
    pub method: &'static str,
    pub one_fire_ms: f64,
    pub many_fires_ms: f64,
    pub full_frame_ms: f64,
    /// Medians of the ratios of neighbouring measurements.
    pub speedup_one: f64,
    pub speedup_many: f64,
}

/// One frame with sixteen fires 15 m away at 1280x720, 96 disparities, one thread.
pub(super) fn measure(
    world: &Arc<World>,
    options: &Options,
    tick: Tick,
) -> Result<Vec<Speed>, RangeEvalError> {
    let stage = Stage::new(RigName::Ours75, world)?;
    let (pair, targets) = many(&stage, options)?;
    let mut papers = FullFrame::new(&stage.rig, stage.num_disparities)?;
    let threads = opencv::core::get_num_threads()?;
    opencv::core::set_num_threads(1)?;
    let speeds: Result<Vec<Speed>, RangeEvalError> = Method::ALL
        .into_iter()
        .map(|method| {
            let mut ranger = open(method, &stage.rig, &config(&stage))?;
            let pairs = if options.quick { 3 } else { PAIRS };
            let speed = one(method, &mut *ranger, &mut papers, &pair, &targets, pairs);
            tick(1);
            speed
        })
        .collect();
    opencv::core::set_num_threads(threads)?;
    speeds
}

/// Time that this thread has had on the processor.
fn spent() -> Duration {
    let now = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec.unsigned_abs() as u32)
}

fn timed_ms<T>(work: impl FnOnce() -> Result<T, RangeEvalError>) -> Result<f64, RangeEvalError> {
    let before = spent();
    black_box(work()?);
    Ok((spent() - before).as_secs_f64() * 1e3)
}

fn one(
    method: Method,
    ranger: &mut dyn Ranger,
    papers: &mut FullFrame,
    pair: &RawPair,
    targets: &[Target],
    pairs: usize,
) -> Result<Speed, RangeEvalError> {
    let (mut ones, mut manys, mut fulls) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..pairs {
        fulls.push(timed_ms(|| papers.match_frames(pair))?);
        manys.push(timed_ms(|| {
            let ranged = targets.iter().map(|target| ranger.range(pair, target));
            Ok(ranged.collect::<Result<Vec<_>, _>>()?)
        })?);
        // One fire: the mean of each by itself.
        ones.push(single(ranger, pair, targets)?);
    }
    let ratios = |times: &[f64]| -> Vec<f64> {
        fulls
            .iter()
            .zip(times)
            .map(|(full, time)| full / time)
            .collect()
    };
    let middle = |values: &[f64]| median(values).unwrap_or(f64::NAN);
    Ok(Speed {
        method: method.name(),
        one_fire_ms: middle(&ones),
        many_fires_ms: middle(&manys),
        full_frame_ms: middle(&fulls),
        speedup_one: middle(&ratios(&ones)),
        speedup_many: middle(&ratios(&manys)),
    })
}

fn single(
    ranger: &mut dyn Ranger,
    pair: &RawPair,
    targets: &[Target],
) -> Result<f64, RangeEvalError> {
    let mut times = Vec::with_capacity(targets.len());
    for target in targets {
        // A pair of its own, so that nothing is shared with the fire before.
        let fresh = pair.clone();
        times.push(timed_ms(|| Ok(ranger.range(&fresh, target)?))?);
    }
    Ok(mean(&times).unwrap_or(f64::NAN))
}

/// A frame put together from sixteen trials, each in its own part of the image.
fn many(stage: &Stage, options: &Options) -> Result<(RawPair, Vec<Target>), RangeEvalError> {
    let mut targets = Vec::new();
    let mut frame: Option<RawPair> = None;
    for k in 0..MANY {
        let (column, row) = ((k % 4) as f64, (k / 4) as f64);
        let (u, v) = (190.0 + 300.0 * column, 95.0 + 175.0 * row);
        let recipe = Recipe {
            depth_m: 15.0..15.0,
            width_m: 0.7..1.1,
            u_px: u..u + 30.0,
            v_px: v..v + 20.0,
            daylight: 0.4..0.8,
            exposure: 0.8..1.4,
            wind_m_s: 0.0..1.0,
            indoors: false,
            hardness: None,
        };
        let Some(trial) =
            stage.trial(&recipe, SeedSet::Report, options.seed ^ 0x3000 ^ k as u64)?
        else {
            continue;
        };
        let part = [u as i32 - 150, v as i32 - 95, 300, 180];
        frame = Some(match frame {
            None => trial.pair,
            Some(frame) => super::stage::pasted(frame, &trial.pair, part)?,
        });
        targets.push(trial.target);
    }
    Ok((frame.ok_or(RangeEvalError::Methods)?, targets))
}
