//! Ground stations' logs (`.tlog`): what was received, each frame behind the logger's clock.
//!
//! A record is 8 bytes, big-endian, microseconds of UTC since 1970 by the logger's clock on arrival,
//! then one MAVLink frame. No header, no index, no checksum of its own; a log that ends in the
//! middle of a record is normal.

use crate::telemetry::{DecodeError, GlobalPosition, Telemetry, decode, message_name};
use crate::wire::{FrameCheck, RawFrame};
use emberfix_frames::ServiceTime;
use serde::Serialize;
use std::collections::BTreeMap;

/// One record of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlogRecord {
    /// When the logger received it, by the logger's clock.
    pub at: ServiceTime,
    /// What it received.
    pub frame: RawFrame,
    /// Whether the frame is what its sender sent.
    pub check: FrameCheck,
}

/// Reads the records of a log that lies in memory.
#[derive(Debug, Clone)]
pub struct TlogReader<'a> {
    rest: &'a [u8],
    skipped_bytes: u64,
}

const STAMP_LEN: usize = 8;

impl<'a> TlogReader<'a> {
    /// From the start of `log`.
    #[must_use]
    pub fn new(log: &'a [u8]) -> Self {
        Self {
            rest: log,
            skipped_bytes: 0,
        }
    }

    /// Bytes so far that belong to no record.
    #[must_use]
    pub fn skipped_bytes(&self) -> u64 {
        self.skipped_bytes
    }

    /// The record that starts here, and its length. A frame whose checksum cannot be tested, or
    /// fails, counts only where the log goes on as a log behind it.
    fn record(&self) -> Option<(TlogRecord, usize)> {
        let (stamp, behind) = self.rest.split_first_chunk::<STAMP_LEN>()?;
        let (frame, check) = RawFrame::at_start(behind)?;
        let length = STAMP_LEN + frame.bytes.len();
        let next_marker = self.rest.get(length + STAMP_LEN);
        let chained = next_marker.is_none_or(|marker| matches!(marker, 0xFD | 0xFE));
        if check != FrameCheck::Good && !chained {
            return None;
        }
        let us = i64::try_from(u64::from_be_bytes(*stamp)).ok()?;
        let at = ServiceTime::from_unix_ns(us.checked_mul(1_000)?);
        Some((TlogRecord { at, frame, check }, length))
    }
}

impl Iterator for TlogReader<'_> {
    type Item = TlogRecord;

    fn next(&mut self) -> Option<TlogRecord> {
        while !self.rest.is_empty() {
            if let Some((record, length)) = self.record() {
                self.rest = &self.rest[length..];
                return Some(record);
            }
            self.rest = &self.rest[1..];
            self.skipped_bytes += 1;
        }
        None
    }
}

/// One record as the logger would have written it.
#[must_use]
pub fn record_bytes(at: ServiceTime, frame: &[u8]) -> Vec<u8> {
    let us = at.unix_ns_u64() / 1_000;
    [&us.to_be_bytes()[..], frame].concat()
}

/// How one message came.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct MessageFigures {
    /// How many, of all senders together.
    pub count: u64,
    /// Their rate over the whole log, Hz.
    pub rate_hz: f64,
    /// Pauses of more than a second between one and the next.
    pub gaps_over_1_s: u64,
    /// The longest pause, seconds.
    pub longest_gap_s: f64,
}

/// What box the estimator's positions fill.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TrackBox {
    /// How many positions.
    pub positions: u64,
    /// Least and greatest latitude, degrees.
    pub latitude_deg: (f64, f64),
    /// Least and greatest longitude, degrees.
    pub longitude_deg: (f64, f64),
    /// Least and greatest altitude above mean sea level, metres.
    pub altitude_msl_m: (f64, f64),
}

/// What a log holds.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct TlogSummary {
    /// From the first to the last record by the logger's clock, seconds.
    pub duration_s: f64,
    /// Records.
    pub frames: u64,
    /// Records whose checksum could not be tested (another dialect) or fails.
    pub unchecked: u64,
    /// Bytes that belong to no record.
    pub skipped_bytes: u64,
    /// By message name.
    pub messages: BTreeMap<String, MessageFigures>,
    /// Frames that said nothing believable, by reason (see [`DecodeError::name`]).
    pub refused: BTreeMap<String, u64>,
    /// Where the vehicle was, if it ever knew.
    pub track: Option<TrackBox>,
    /// SYSTEM_TIME messages that claimed a UTC that cannot be.
    pub absurd_utc: u64,
}

impl TlogSummary {
    /// Of a log that lies in memory, through the same reader and decoder as a live link.
    #[must_use]
    pub fn of(log: &[u8]) -> Self {
        let mut summary = Summing::default();
        let mut reader = TlogReader::new(log);
        reader.by_ref().for_each(|record| summary.add(&record));
        summary.finish(reader.skipped_bytes())
    }
}

#[derive(Default)]
struct Summing {
    summary: TlogSummary,
    span: Option<(ServiceTime, ServiceTime)>,
    last: BTreeMap<String, ServiceTime>,
}

impl Summing {
    fn add(&mut self, record: &TlogRecord) {
        let (first, latest) = self.span.unwrap_or((record.at, record.at));
        self.span = Some((first, latest.max(record.at)));
        self.summary.frames += 1;
        self.count(&message_name(record.frame.message_id), record.at);
        if record.check == FrameCheck::Good {
            self.read(decode(&record.frame));
        } else {
            self.summary.unchecked += 1;
        }
    }

    fn count(&mut self, name: &str, at: ServiceTime) {
        let figures = self.summary.messages.entry(name.to_owned()).or_default();
        figures.count += 1;
        if let Some(before) = self.last.insert(name.to_owned(), at) {
            let gap_s = (at - before).as_secs_f64();
            figures.longest_gap_s = figures.longest_gap_s.max(gap_s);
            figures.gaps_over_1_s += u64::from(gap_s > 1.0);
        }
    }

    fn read(&mut self, said: Result<Telemetry, DecodeError>) {
        match said {
            Ok(Telemetry::GlobalPosition(position)) => {
                let track = self.summary.track.take();
                self.summary.track = Some(grown(track, &position));
            }
            Ok(Telemetry::SystemTime(time)) => {
                self.summary.absurd_utc += u64::from(time.utc_is_absurd());
            }
            Ok(_) => {}
            Err(error) => {
                *self
                    .summary
                    .refused
                    .entry(error.name().to_owned())
                    .or_default() += 1;
            }
        }
    }

    fn finish(mut self, skipped_bytes: u64) -> TlogSummary {
        let duration_s = self
            .span
            .map_or(0.0, |(first, last)| (last - first).as_secs_f64());
        self.summary.duration_s = duration_s;
        self.summary.skipped_bytes = skipped_bytes;
        for figures in self.summary.messages.values_mut() {
            figures.rate_hz = if duration_s > 0.0 {
                figures.count as f64 / duration_s
            } else {
                0.0
            };
        }
        self.summary
    }
}

fn grown(track: Option<TrackBox>, position: &GlobalPosition) -> TrackBox {
    let altitude_m = position.altitude.m();
    let (latitude, longitude) = (position.latitude_deg, position.longitude_deg);
    let wider = |(least, most): (f64, f64), value: f64| (least.min(value), most.max(value));
    match track {
        None => TrackBox {
            positions: 1,
            latitude_deg: (latitude, latitude),
            longitude_deg: (longitude, longitude),
            altitude_msl_m: (altitude_m, altitude_m),
        },
        Some(track) => TrackBox {
            positions: track.positions + 1,
            latitude_deg: wider(track.latitude_deg, latitude),
            longitude_deg: wider(track.longitude_deg, longitude),
            altitude_msl_m: wider(track.altitude_msl_m, altitude_m),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outgoing::{Encoder, autopilot_heartbeat};
    use crate::wire::Address;

    fn log(seconds: &[i64]) -> Vec<u8> {
        let mut encoder = Encoder::new(Address::new(1, 1));
        let record = |second: &i64| {
            let at = ServiceTime::from_unix_ns((1_700_000_000 + second) * 1_000_000_000);
            record_bytes(at, &encoder.encode(&autopilot_heartbeat(true)))
        };
        seconds.iter().flat_map(record).collect()
    }

    #[test]
    fn times_and_frames_come_back() {
        let log = log(&[0, 1]);
        let records: Vec<TlogRecord> = TlogReader::new(&log).collect();
        assert_eq!(records.len(), 2);
        assert_eq!((records[1].at - records[0].at).as_secs_f64(), 1.0);
        assert_eq!(
            (records[1].frame.sequence, records[1].check),
            (1, FrameCheck::Good)
        );
    }

    #[test]
    fn a_log_that_ends_inside_a_record_gives_all_whole_ones() {
        let log = log(&[0, 1, 2]);
        let mut reader = TlogReader::new(&log[..log.len() - 3]);
        assert_eq!(reader.by_ref().count(), 2);
        assert!(reader.skipped_bytes() > 0);
    }

    #[test]
    fn damage_inside_costs_the_damaged_record_only() {
        let mut bytes = log(&[0, 1, 2]);
        let record = bytes.len() / 3;
        bytes.drain(record + 10..record + 14);
        let seconds: Vec<i64> = TlogReader::new(&bytes)
            .map(|r| r.at.unix_ns() / 1_000_000_000 - 1_700_000_000)
            .collect();
        assert_eq!(seconds, [0, 2]);
    }

    #[test]
    fn a_pause_is_a_gap() {
        let summary = TlogSummary::of(&log(&[0, 1, 5, 6]));
        let heartbeat = summary.messages["HEARTBEAT"];
        assert_eq!((heartbeat.count, heartbeat.gaps_over_1_s), (4, 1));
        assert_eq!((heartbeat.longest_gap_s, summary.duration_s), (4.0, 6.0));
    }
}
