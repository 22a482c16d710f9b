//! An MCAP byte stream to pairs, calibrations and MAVLink frames: sans-I/O.

use super::blocks::{BlockReader, RawMessage};
use super::messages::{self, Refusal, Role, StatedCalibration};
use super::{PairAssembler, SPECTRA, StereoPair, StreamCounters, note};
use crate::alarm::Action;
use crate::assess::spectrum::Spectrum;
use bytes::Bytes;
use emberfix_calib::Eye;
use emberfix_frames::{ServiceTime, Stamped};
use std::collections::VecDeque;

/// What an MCAP stream tells us.
#[derive(Debug, Clone, PartialEq)]
pub enum StreamEvent {
    /// A pair of images, or a left one alone.
    Pair(Stamped<StereoPair>),
    /// One MAVLink frame, the bytes as they came.
    Mavlink {
        /// When it arrived.
        arrived: ServiceTime,
        /// The frame.
        bytes: Bytes,
    },
    /// What an operator did about an alarm.
    Action {
        /// When it arrived.
        arrived: ServiceTime,
        /// What was done.
        action: Action,
    },
    /// An eye's calibration as the sender has it.
    Calibration {
        /// When it arrived.
        arrived: ServiceTime,
        /// Whose.
        eye: Eye,
        /// What it says.
        stated: StatedCalibration,
    },
}

/// Turns messages into events; the part that live streams and recordings share.
pub(crate) struct MessageReader {
    pub assembler: PairAssembler,
    spectra: VecDeque<Spectrum>,
    pub counters: StreamCounters,
}

impl MessageReader {
    pub fn new(assembler: PairAssembler) -> Self {
        Self {
            assembler,
            spectra: VecDeque::new(),
            counters: StreamCounters::default(),
        }
    }

    /// Takes one message in and appends what it completes.
    pub fn take(
        &mut self,
        message: &RawMessage,
        arrived: ServiceTime,
        events: &mut VecDeque<StreamEvent>,
    ) {
        if let Err(refusal) = self.understand(message, arrived, events) {
            self.refuse(refusal);
        }
        self.drain(events);
    }

    /// The stream is over.
    pub fn end(&mut self, events: &mut VecDeque<StreamEvent>) {
        self.assembler.end_stream(&mut self.counters);
        self.drain(events);
    }

    fn drain(&mut self, events: &mut VecDeque<StreamEvent>) {
        while let Some(mut pair) = self.assembler.pop() {
            pair.value.spectra = self.spectra.drain(..).collect();
            events.push_back(StreamEvent::Pair(pair));
        }
    }

    fn understand(
        &mut self,
        message: &RawMessage,
        arrived: ServiceTime,
        events: &mut VecDeque<StreamEvent>,
    ) -> Result<(), Refusal> {
        match Role::of(&message.channel.topic) {
            Role::Image(eye) => {
                let image = messages::image(message)?;
                self.assembler
                    .push(eye.into(), image, arrived, &mut self.counters);
            }
            Role::Calibration(eye) => {
                let stated = messages::calibration(message)?;
                self.counters.calibrations += 1;
                events.push_back(StreamEvent::Calibration {
                    arrived,
                    eye: eye.into(),
                    stated,
                });
            }
            Role::Mavlink if message.channel.message_encoding == "mavlink" => {
                self.counters.mavlink += 1;
                events.push_back(StreamEvent::Mavlink {
                    arrived,
                    bytes: message.data.clone(),
                });
            }
            Role::Mavlink => return Err(Refusal::Unreadable),
            Role::Action => {
                let action = serde_json::from_slice(&message.data);
                let action = action.map_err(|_| Refusal::Unreadable)?;
                self.counters.actions += 1;
                events.push_back(StreamEvent::Action { arrived, action });
            }
            Role::Spectrometer => {
                let spectrum = messages::spectrum(message)?;
                self.counters.spectrometer += 1;
                self.spectra.push_back(spectrum);
                if self.spectra.len() > SPECTRA {
                    self.spectra.pop_front();
                    self.counters.spectra_shed += 1;
                }
            }
            Role::Other => self.counters.other += 1,
        }
        Ok(())
    }

    fn refuse(&mut self, refusal: Refusal) {
        let counters = &mut self.counters;
        match refusal {
            Refusal::Unreadable => note(&mut counters.unreadable, "message can't be read: dropped"),
            Refusal::Unstamped => note(&mut counters.unstamped, "image without timestamp: dropped"),
            Refusal::UnknownFormat => {
                note(
                    &mut counters.unknown_format,
                    "image neither jpeg nor png nor raw: dropped",
                );
            }
        }
    }
}

/// One MCAP stream, from its first byte to its last.
pub struct McapStream {
    blocks: BlockReader,
    reader: MessageReader,
    events: VecDeque<StreamEvent>,
}

impl McapStream {
    /// For pairs within `max_skew_s` seconds.
    #[must_use]
    pub fn new(max_skew_s: f64) -> Self {
        Self {
            blocks: BlockReader::new(),
            reader: MessageReader::new(PairAssembler::new(max_skew_s)),
            events: VecDeque::new(),
        }
    }

    /// Takes bytes in. `arrived` is when they came; without it each message's log time counts.
    pub fn push(&mut self, bytes: &[u8], arrived: Option<ServiceTime>) {
        for block in self.blocks.push(bytes, &mut self.reader.counters) {
            for message in block.messages {
                let arrived = arrived.unwrap_or_else(|| log_time(&message));
                self.reader.take(&message, arrived, &mut self.events);
            }
        }
    }

    /// The next event.
    pub fn pop(&mut self) -> Option<StreamEvent> {
        self.events.pop_front()
    }

    /// True after the stream's own end, or when nothing more of it can be understood.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.blocks.has_ended()
    }

    /// No more bytes will come; the last events can be fetched, and the next stream can begin.
    pub fn end(&mut self) {
        self.blocks.finish(&mut self.reader.counters);
        self.reader.end(&mut self.events);
        self.blocks = BlockReader::new();
    }

    /// What stood in the streams so far.
    #[must_use]
    pub fn counters(&self) -> StreamCounters {
        self.reader.counters
    }
}

/// A message's log time on the service clock; beyond 2262 it saturates.
pub(crate) fn log_time(message: &RawMessage) -> ServiceTime {
    ServiceTime::from_unix_ns(i64::try_from(message.log_time_ns).unwrap_or(i64::MAX))
}
