//! A recording, finished or torn, in the order of its log times.
//!
//! The file is read twice: once to check every block and to index its messages, then message by
//! message. Memory: 32 bytes a message, and a few unpacked blocks. What is whole is used;
//! what is not is counted, and known when the recording is opened.

use super::blocks::{Block, BlockReader, Dictionary, RawMessage};
use super::mcap_stream::{MessageReader, log_time};
use super::messages::{self, Role, StatedCalibration};
use super::{
    PairAssembler, SourceCounters, SourceError, StereoPair, StereoSource, StreamCounters,
    StreamEvent,
};
use crate::alarm::Action;
use bytes::Bytes;
use emberfix_calib::{Eye, Rig};
use emberfix_frames::{ServiceTime, Stamped};
use std::collections::VecDeque;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Unpacked blocks that are kept: writers interleave a few at most.
const CACHED_BLOCKS: usize = 8;
/// Bytes that are read at once.
const READ_BYTES: usize = 256 * 1024;
/// What a recording must hold something of.
const INPUT_TOPICS: &str = "/stereo/left/image or /mavlink/raw";

/// One thing that reached the service when the recording was made.
#[derive(Debug, Clone, PartialEq)]
pub enum Recorded {
    /// A MAVLink frame.
    Mavlink {
        /// When it arrived.
        arrived: ServiceTime,
        /// The bytes as they came.
        bytes: Bytes,
    },
    /// What an operator did about an alarm.
    Action {
        /// When it arrived.
        arrived: ServiceTime,
        /// What was done.
        action: Action,
    },
    /// A pair; `value.arrived` is when it was complete.
    Pair(Stamped<StereoPair>),
    /// A calibration as the sender stated it.
    Calibration {
        /// When it arrived.
        arrived: ServiceTime,
        /// Whose.
        eye: Eye,
        /// What it says; [`StatedCalibration::check`] holds it against the rig.
        stated: StatedCalibration,
    },
}

/// A message's place, sorted by log time, then role, then place in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Entry {
    log_time_ns: u64,
    role: Role,
    block: u32,
    index: u32,
}

/// An opened recording.
pub struct Recording {
    path: PathBuf,
    file: File,
    dictionary: Dictionary,
    /// Offset and length of each block.
    blocks: Vec<(u64, u64)>,
    /// What is left to replay, the next one last.
    entries: Vec<Entry>,
    cache: VecDeque<(u32, Vec<RawMessage>)>,
    reader: MessageReader,
    events: VecDeque<StreamEvent>,
    finished: bool,
    delivered: u64,
}

impl Recording {
    /// Opens and checks a recording.
    ///
    /// # Errors
    /// [`SourceError::Io`], [`SourceError::NotMcap`], or [`SourceError::NothingRecorded`].
    pub fn open(path: &Path, rig: &Rig) -> Result<Self, SourceError> {
        Self::open_with_skew(path, rig.max_skew_s())
    }

    /// Opens and checks a recording, for pairs within `max_skew_s` seconds.
    ///
    /// # Errors
    /// As [`Recording::open`].
    pub fn open_with_skew(path: &Path, max_skew_s: f64) -> Result<Self, SourceError> {
        let io = |source| SourceError::Io {
            source_name: path.display().to_string(),
            source,
        };
        let file = File::open(path).map_err(io)?;
        let mut survey = Survey::of(&file, Dictionary::default()).map_err(io)?;
        if survey.counters.undeclared > 0 {
            // The chunk that declared the channels is damaged; the summary repeats them.
            let known = survey.reader.into_dictionary();
            survey = Survey::of(&file, known).map_err(io)?;
        }
        survey.into_recording(path, file, max_skew_s)
    }

    /// What could and could not be used, so far; losses are all known from the start.
    #[must_use]
    pub fn counters(&self) -> StreamCounters {
        self.reader.counters
    }

    /// The next event in log-time order; `None` at the end.
    ///
    /// # Errors
    /// [`SourceError::Io`] when the file can no longer be read.
    pub fn next_event(&mut self) -> Result<Option<Recorded>, SourceError> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Ok(Some(event.into()));
            }
            let Some(entry) = self.entries.pop() else {
                if std::mem::replace(&mut self.finished, true) {
                    return Ok(None);
                }
                self.reader.end(&mut self.events);
                continue;
            };
            if let Some(message) = self.message(entry)? {
                self.reader
                    .take(&message, log_time(&message), &mut self.events);
            }
        }
    }

    fn message(&mut self, entry: Entry) -> Result<Option<RawMessage>, SourceError> {
        if !self.cache.iter().any(|(block, _)| *block == entry.block) {
            let unpacked = self.unpack(entry.block).map_err(|source| SourceError::Io {
                source_name: self.path.display().to_string(),
                source,
            })?;
            self.cache.truncate(CACHED_BLOCKS - 1);
            self.cache.push_front((entry.block, unpacked));
        }
        let found = self.cache.iter().find(|(block, _)| *block == entry.block);
        Ok(found
            .and_then(|(_, messages)| messages.get(entry.index as usize))
            .cloned())
    }

    fn unpack(&mut self, block: u32) -> std::io::Result<Vec<RawMessage>> {
        let Some((offset, len)) = self.blocks.get(block as usize).copied() else {
            return Ok(Vec::new());
        };
        self.file.seek(SeekFrom::Start(offset))?;
        let mut record = Vec::new();
        (&self.file).take(len).read_to_end(&mut record)?;
        let (Some(opcode), Some(body)) = (record.first(), record.get(9..)) else {
            return Ok(Vec::new());
        };
        // The survey has counted what is wrong with this block already.
        let mut already_counted = StreamCounters::default();
        Ok(self.dictionary.unpack(*opcode, body, &mut already_counted))
    }
}

impl From<StreamEvent> for Recorded {
    fn from(event: StreamEvent) -> Self {
        match event {
            StreamEvent::Pair(pair) => Self::Pair(pair),
            StreamEvent::Mavlink { arrived, bytes } => Self::Mavlink { arrived, bytes },
            StreamEvent::Action { arrived, action } => Self::Action { arrived, action },
            StreamEvent::Calibration {
                arrived,
                eye,
                stated,
            } => Self::Calibration {
                arrived,
                eye,
                stated,
            },
        }
    }
}

/// As a camera: the pairs alone.
impl StereoSource for Recording {
    fn next_pair(&mut self) -> Result<Option<Stamped<StereoPair>>, SourceError> {
        while let Some(event) = self.next_event()? {
            if let Recorded::Pair(pair) = event {
                self.delivered += 1;
                return Ok(Some(pair));
            }
        }
        Ok(None)
    }

    fn counters(&self) -> SourceCounters {
        SourceCounters {
            delivered: self.delivered,
            openings: 1,
            stream: self.reader.counters,
            ..SourceCounters::default()
        }
    }
}

/// The first reading: what stands where.
struct Survey {
    reader: BlockReader,
    counters: StreamCounters,
    blocks: Vec<(u64, u64)>,
    entries: Vec<Entry>,
    rights: Vec<ServiceTime>,
    bytes: u64,
}

impl Survey {
    fn of(mut file: &File, known: Dictionary) -> std::io::Result<Self> {
        let mut survey = Self {
            reader: BlockReader::knowing(known),
            counters: StreamCounters::default(),
            blocks: Vec::new(),
            entries: Vec::new(),
            rights: Vec::new(),
            bytes: 0,
        };
        file.rewind()?;
        survey.read(file)?;
        survey.reader.finish(&mut survey.counters);
        Ok(survey)
    }

    fn read(&mut self, mut file: &File) -> std::io::Result<()> {
        let mut buffer = vec![0; READ_BYTES];
        loop {
            let count = file.read(&mut buffer)?;
            if count == 0 {
                return Ok(());
            }
            self.bytes += count as u64;
            for block in self.reader.push(&buffer[..count], &mut self.counters) {
                self.index(&block);
            }
        }
    }

    fn index(&mut self, block: &Block) {
        let Ok(number) = u32::try_from(self.blocks.len()) else {
            return;
        };
        self.blocks.push((block.offset, block.len));
        for (message, index) in block.messages.iter().zip(0..) {
            let role = Role::of(&message.channel.topic);
            if role == Role::Other {
                self.counters.other += 1;
                continue;
            }
            if role == Role::Image(messages::EyeRank::Right) {
                self.rights
                    .extend(messages::image(message).ok().map(|image| image.at));
            }
            self.entries.push(Entry {
                log_time_ns: message.log_time_ns,
                role,
                block: number,
                index,
            });
        }
    }

    fn into_recording(
        mut self,
        path: &Path,
        file: File,
        max_skew_s: f64,
    ) -> Result<Recording, SourceError> {
        if self.counters.garbage_bytes == self.bytes {
            return Err(SourceError::NotMcap {
                path: path.to_owned(),
                bytes: self.bytes,
            });
        }
        let is_input = |entry: &Entry| matches!(entry.role, Role::Image(_) | Role::Mavlink);
        if !self.entries.iter().any(is_input) {
            return Err(SourceError::NothingRecorded {
                path: path.to_owned(),
                expected: INPUT_TOPICS,
                lost_bytes: self.counters.lost_bytes,
                bad_chunks: self.counters.bad_chunks,
            });
        }
        if self.counters.lost_bytes > 0 || self.counters.bad_chunks > 0 {
            tracing::warn!(
                path = %path.display(),
                lost_bytes = self.counters.lost_bytes,
                bad_chunks = self.counters.bad_chunks,
                "recording is torn or damaged: what is whole is used"
            );
        }
        self.entries.sort_unstable_by(|a, b| b.cmp(a));
        let assembler = PairAssembler::new(max_skew_s).knowing_rights(self.rights);
        let mut reader = MessageReader::new(assembler);
        reader.counters = self.counters;
        Ok(Recording {
            path: path.to_owned(),
            file,
            dictionary: self.reader.into_dictionary(),
            blocks: self.blocks,
            entries: self.entries,
            cache: VecDeque::new(),
            reader,
            events: VecDeque::new(),
            finished: false,
            delivered: 0,
        })
    }
}
