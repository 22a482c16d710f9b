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
            spectra: Vec::new(),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ingest::ImageEncoding;
    use crate::ingest::testing::at;

    fn image(ms: i64) -> EncodedImage {
        EncodedImage {
            encoding: ImageEncoding::Jpeg,
            bytes: bytes::Bytes::new(),
            at: at(ms),
        }
    }

    /// Feeds (eye, exposure ms), each arriving 10 ms later; gives (left ms, right ms) of the pairs.
    fn pairs_of(
        assembler: &mut PairAssembler,
        images: &[(Eye, i64)],
    ) -> (Vec<(i64, Option<i64>)>, StreamCounters) {
        let mut counters = StreamCounters::default();
        let mut pairs = Vec::new();
        for (eye, ms) in images {
            assembler.push(*eye, image(*ms), at(ms + 10), &mut counters);
            pairs.extend(std::iter::from_fn(|| assembler.pop()));
        }
        let ms = |time: ServiceTime| (time - at(0)).as_millis() as i64;
        let times = pairs.iter().map(|pair| {
            (
                ms(pair.at),
                pair.value.right.as_ref().map(|right| ms(right.at)),
            )
        });
        (times.collect(), counters)
    }

    use Eye::{Left as L, Right as R};

    #[test]
    fn eyes_within_the_skew_make_a_pair_in_either_order() {
        let mut assembler = PairAssembler::new(0.002);
        let (pairs, counters) = pairs_of(
            &mut assembler,
            &[(L, 0), (R, 2), (R, 99), (L, 100), (L, 200), (R, 200)],
        );
        assert_eq!(pairs, [(0, Some(2)), (100, Some(99)), (200, Some(200))]);
        assert_eq!(
            (counters.pairs, counters.left_alone, counters.right_alone),
            (3, 0, 0)
        );
    }

    #[test]
    fn eyes_beyond_the_skew_make_none() {
        let mut assembler = PairAssembler::new(0.002);
        let (pairs, counters) = pairs_of(
            &mut assembler,
            &[(L, 0), (R, 3), (L, 100), (R, 97), (R, 100)],
        );
        assert_eq!(pairs, [(0, None), (100, Some(100))]);
        assert_eq!((counters.right_alone, counters.backwards), (2, 0));
    }

    #[test]
    fn a_dead_right_eye_delays_and_never_stops_the_left_one() {
        let mut assembler = PairAssembler::new(0.002);
        let (pairs, _) = pairs_of(&mut assembler, &[(L, 0), (L, 100), (L, 200), (L, 300)]);
        assert_eq!(pairs, [(0, None), (100, None)]);
        let mut counters = StreamCounters::default();
        assembler.end_stream(&mut counters);
        assert_eq!(counters.left_alone, 2);
    }

    #[test]
    fn a_dead_left_eye_keeps_nothing_waiting() {
        let mut assembler = PairAssembler::new(0.002);
        let rights: Vec<_> = (0..100).map(|n| (R, n * 100)).collect();
        let (pairs, counters) = pairs_of(&mut assembler, &rights);
        assert_eq!((pairs.len(), counters.right_alone), (0, 98));
    }

    #[test]
    fn one_lost_right_image_costs_one_pair() {
        let mut assembler = PairAssembler::new(0.002);
        let (pairs, _) = pairs_of(
            &mut assembler,
            &[(L, 0), (R, 0), (L, 100), (L, 200), (R, 200)],
        );
        assert_eq!(pairs, [(0, Some(0)), (100, None), (200, Some(200))]);
    }

    #[test]
    fn a_recording_knows_at_once_that_no_right_image_will_come() {
        let mut assembler = PairAssembler::new(0.002).knowing_rights(vec![at(100)]);
        let (pairs, _) = pairs_of(&mut assembler, &[(L, 0)]);
        assert_eq!(pairs, [(0, None)]);
        let (pairs, _) = pairs_of(&mut assembler, &[(L, 100), (R, 100), (L, 200)]);
        assert_eq!(pairs, [(100, Some(100)), (200, None)]);
    }

    #[test]
    fn timestamps_that_go_backwards_or_ahead_are_counted_and_do_not_poison_the_stream() {
        let mut assembler = PairAssembler::new(0.002);
        let mut counters = StreamCounters::default();
        assembler.push(L, image(100), at(110), &mut counters);
        assembler.push(L, image(100), at(111), &mut counters);
        assembler.push(L, image(50), at(112), &mut counters);
        assembler.push(L, image(1_000_000), at(113), &mut counters);
        assembler.push(L, image(200), at(210), &mut counters);
        assembler.push(R, image(200), at(211), &mut counters);
        assert_eq!((counters.backwards, counters.from_the_future), (2, 1));
        assert_eq!((counters.left_alone, counters.pairs), (1, 1));
    }
}
