//! Left and right images to pairs, by their exposure times. Pure.

use super::{EncodedImage, StereoPair, StreamCounters, note};
use emberfix_calib::Eye;
use emberfix_frames::{ServiceTime, SignedDuration, Stamped, seconds};
use std::collections::VecDeque;

/// An image, and when it reached us.
#[derive(Debug)]
struct Waiting {
    image: EncodedImage,
    arrived: ServiceTime,
}

/// Matches the eyes' images.
///
/// A left image waits until a right one of the same moment is there, until the right eye has gone
/// past it, or until [`Self::PENDING_PER_EYE`] later left ones wait with it (a dead right eye); then
/// it goes on alone. A right image that the left eye has gone past is dropped. All by the order of
/// the images, not by a clock: the same stream gives the same pairs.
pub struct PairAssembler {
    max_skew: SignedDuration,
    left: VecDeque<Waiting>,
    right: VecDeque<Waiting>,
    latest: [Option<ServiceTime>; 2],
    /// All right exposures there will ever be, sorted; known of a recording, not of a live stream.
    known_rights: Option<Vec<ServiceTime>>,
    sequence: u64,
    ready: VecDeque<Stamped<StereoPair>>,
}

/// How much later than its arrival an exposure may be stamped: two clocks on one computer jitter.
const FUTURE_LIMIT: SignedDuration = SignedDuration::from_millis(500);

impl PairAssembler {
    /// Images of one eye that wait for the other eye.
    pub const PENDING_PER_EYE: usize = 2;

    /// For a rig's greatest skew, seconds.
    #[must_use]
    pub fn new(max_skew_s: f64) -> Self {
        Self {
            max_skew: seconds(max_skew_s),
            left: VecDeque::new(),
            right: VecDeque::new(),
            latest: [None; 2],
            known_rights: None,
            sequence: 0,
            ready: VecDeque::new(),
        }
    }

    /// Tells the assembler which right images will come, so that a left one without a partner
    /// need not wait.
    #[must_use]
    pub fn knowing_rights(mut self, mut exposures: Vec<ServiceTime>) -> Self {
        exposures.sort_unstable();
        self.known_rights = Some(exposures);
        self
    }

    /// Takes one image in. `counters` learn what was dropped.
    pub fn push(
        &mut self,
        eye: Eye,
        image: EncodedImage,
        arrived: ServiceTime,
        counters: &mut StreamCounters,
    ) {
        if !self.is_in_order(eye, image.at, arrived, counters) {
            return;
        }
        let waiting = Waiting { image, arrived };
        match eye {
            Eye::Left => self.left.push_back(waiting),
            Eye::Right => self.right.push_back(waiting),
        }
        self.settle(arrived, counters);
    }

    /// The next pair that is complete, or as complete as it will get.
    pub fn pop(&mut self) -> Option<Stamped<StereoPair>> {
        self.ready.pop_front()
    }

    /// The stream is over: left images that still wait go on alone. A next stream may begin earlier.
    pub fn end_stream(&mut self, counters: &mut StreamCounters) {
        while let Some(left) = self.left.pop_front() {
            let arrived = left.arrived;
            self.emit(left, None, arrived, counters);
        }
        while self.right.pop_front().is_some() {
            counters.right_alone += 1;
        }
        self.latest = [None; 2];
    }

    fn is_in_order(
        &mut self,
        eye: Eye,
        at: ServiceTime,
        arrived: ServiceTime,
        counters: &mut StreamCounters,
    ) -> bool {
        if at - arrived > FUTURE_LIMIT {
            note(
                &mut counters.from_the_future,
                "image stamped later than it arrived: dropped",
            );
            return false;
        }
        let latest = match eye {
            Eye::Left => &mut self.latest[0],
            Eye::Right => &mut self.latest[1],
        };
        if latest.is_some_and(|latest| at <= latest) {
            note(
                &mut counters.backwards,
                "image timestamps go backwards: dropped",
            );
            return false;
        }
        *latest = Some(at);
        true
    }

    /// Brings out every pair that is decided. `now` is the arrival of what decides.
    fn settle(&mut self, now: ServiceTime, counters: &mut StreamCounters) {
        while let Some(left) = self.left.front() {
            let at = left.image.at;
            let Some(right) = self.right.front() else {
                break;
            };
            let skew = right.image.at - at;
            if skew.abs() <= self.max_skew {
                if let (Some(left), Some(right)) = (self.left.pop_front(), self.right.pop_front()) {
                    self.emit(left, Some(right), now, counters);
                }
            } else if skew.is_negative() {
                self.right.pop_front();
                note(
                    &mut counters.right_alone,
                    "right image without a left one: dropped",
                );
            } else if let Some(left) = self.left.pop_front() {
                self.emit(left, None, now, counters);
            }
        }
        while self.left.len() > Self::PENDING_PER_EYE || self.front_is_hopeless() {
            let Some(left) = self.left.pop_front() else {
                break;
            };
            self.emit(left, None, now, counters);
        }
        while self.right.len() > Self::PENDING_PER_EYE {
            self.right.pop_front();
            note(
                &mut counters.right_alone,
                "right image without a left one: dropped",
            );
        }
    }

    /// True when it is known that no right image will match the left one in front.
    fn front_is_hopeless(&self) -> bool {
        let (Some(left), Some(rights)) = (self.left.front(), &self.known_rights) else {
            return false;
        };
        let earliest = left.image.at - self.max_skew;
        let first = rights.partition_point(|right| *right < earliest);
        rights
            .get(first)
            .is_none_or(|right| *right - left.image.at > self.max_skew)
    }

    fn emit(
        &mut self,
        left: Waiting,
        right: Option<Waiting>,
        arrived: ServiceTime,
        counters: &mut StreamCounters,
    ) {
        match right {
            Some(_) => counters.pairs += 1,
            None => note(
                &mut counters.left_alone,
                "left image without a right one: one eye only",
            ),
        }
        let skew = right.as_ref().map(|right| right.image.at - left.image.at);
        let pair = StereoPair {
            sequence: self.sequence,
            arrived,
            skew: skew.unwrap_or(SignedDuration::ZERO),
            right: right.map(|right| right.image),
            left: left.image,
        };
        self.sequence += 1;
        self.ready.push_back(Stamped {
            at: pair.left.at,
            value: pair,
        });
    }
}
