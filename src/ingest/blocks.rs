//! MCAP bytes to messages: sans-I/O, top-level record by top-level record.
//!
//! A chunk is checked (length, compression, CRC) before any of its messages goes out, so a damaged
//! chunk costs that chunk and nothing else. Memory follows the bytes that came, never a length field.

use super::{StreamCounters, note};
use bytes::Bytes;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::Arc;

/// Largest record, and largest unpacked chunk, that is read: a raw pair of 24 Mpx fits.
pub const RECORD_LIMIT_BYTES: usize = 160 << 20;

/// Opcode and length in front of every record.
const RECORD_HEAD_BYTES: u64 = 9;

/// What a channel carries.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct ChannelInfo {
    pub topic: String,
    pub message_encoding: String,
    /// Empty when the channel has no schema.
    pub schema: String,
}

/// One message, not yet understood.
#[derive(Debug, Clone)]
pub(crate) struct RawMessage {
    pub channel: Arc<ChannelInfo>,
    pub log_time_ns: u64,
    pub publish_time_ns: u64,
    pub data: Bytes,
}

/// The messages of one top-level record (a chunk, or a message that stands alone).
#[derive(Debug)]
pub(crate) struct Block {
    /// Where the record begins in the stream, and its length with opcode and length field.
    pub offset: u64,
    pub len: u64,
    pub messages: Vec<RawMessage>,
}

/// Schemas and channels that a stream has declared; the first declaration of a number counts.
#[derive(Debug, Default)]
pub(crate) struct Dictionary {
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Arc<ChannelInfo>>,
}

impl Dictionary {
    fn declare_channel(&mut self, channel: mcap::records::Channel) {
        let schema = self
            .schemas
            .get(&channel.schema_id)
            .cloned()
            .unwrap_or_default();
        let info = ChannelInfo {
            topic: channel.topic,
            message_encoding: channel.message_encoding,
            schema,
        };
        self.channels
            .entry(channel.id)
            .or_insert_with(|| Arc::new(info));
    }

    /// Takes one record in; a message comes back with its channel.
    fn take(
        &mut self,
        opcode: u8,
        data: &[u8],
        counters: &mut StreamCounters,
    ) -> Option<RawMessage> {
        if !matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
            return None;
        }
        match mcap::parse_record(opcode, data) {
            Ok(Record::Schema { header, .. }) => {
                self.schemas.entry(header.id).or_insert(header.name);
                None
            }
            Ok(Record::Channel(channel)) => {
                self.declare_channel(channel);
                None
            }
            Ok(Record::Message { header, data }) => {
                let Some(channel) = self.channels.get(&header.channel_id) else {
                    note(
                        &mut counters.undeclared,
                        "MCAP message of a channel never declared",
                    );
                    return None;
                };
                Some(RawMessage {
                    channel: Arc::clone(channel),
                    log_time_ns: header.log_time,
                    publish_time_ns: header.publish_time,
                    data: Bytes::copy_from_slice(&data),
                })
            }
            _ => {
                note(&mut counters.unreadable, "MCAP record that can't be parsed");
                None
            }
        }
    }

    /// The messages of one top-level record.
    pub fn unpack(
        &mut self,
        opcode: u8,
        body: &[u8],
        counters: &mut StreamCounters,
    ) -> Vec<RawMessage> {
        if opcode != op::CHUNK {
            return self.take(opcode, body, counters).into_iter().collect();
        }
        let Some(records) = unpack_chunk(body) else {
            note(&mut counters.bad_chunks, "MCAP chunk dropped: damaged");
            return Vec::new();
        };
        let messages = records
            .iter()
            .filter_map(|(code, data)| self.take(*code, data, counters));
        messages.collect()
    }
}

/// All records of a chunk, or none when anything about it is wrong.
fn unpack_chunk(body: &[u8]) -> Option<Vec<(u8, Vec<u8>)>> {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(RECORD_LIMIT_BYTES);
    let mut reader = LinearReader::new_with_options(options);
    let mut head = [op::CHUNK; RECORD_HEAD_BYTES as usize];
    head[1..].copy_from_slice(&u64::try_from(body.len()).ok()?.to_le_bytes());
    insert(&mut reader, &head);
    let mut rest = body;
    let (mut records, mut total) = (Vec::new(), 0_usize);
    while let Some(event) = reader.next_event() {
        match event.ok()? {
            LinearReadEvent::ReadRequest(wanted) => {
                // At the chunk's exact end the reader asks for a next record: that is the end.
                let (now, later) = rest.split_at(wanted.min(rest.len()));
                insert(&mut reader, now);
                rest = later;
            }
            LinearReadEvent::Record { opcode, data } => {
                total = total
                    .checked_add(data.len())
                    .filter(|sum| *sum <= RECORD_LIMIT_BYTES)?;
                records.push((opcode, data.to_vec()));
            }
        }
    }
    Some(records)
}

/// Hands bytes over; none at all means the end.
fn insert(reader: &mut LinearReader, bytes: &[u8]) {
    reader.insert(bytes.len()).copy_from_slice(bytes);
    reader.notify_read(bytes.len());
}

/// Where a stream stands.
enum State {
    /// Looking for the magic; holds the last bytes, which may be its beginning.
    Searching(Vec<u8>),
    Reading(Box<LinearReader>),
    /// After the footer: nothing more belongs to the stream.
    Ended,
    /// After a record that can't be framed: nothing more can be understood.
    Lost,
}

/// An MCAP stream, fed piece by piece.
pub(crate) struct BlockReader {
    state: State,
    dictionary: Dictionary,
    /// Where the next top-level record begins.
    offset: u64,
    /// Bytes that came since the magic, it included, and garbage before it.
    taken: u64,
}

impl BlockReader {
    pub fn new() -> Self {
        Self::knowing(Dictionary::default())
    }

    /// For a stream whose channels are known already.
    pub fn knowing(dictionary: Dictionary) -> Self {
        Self {
            state: State::Searching(Vec::new()),
            dictionary,
            offset: 0,
            taken: 0,
        }
    }

    /// True once the footer has been seen, or nothing more can be understood.
    pub fn has_ended(&self) -> bool {
        matches!(self.state, State::Ended | State::Lost)
    }

    pub fn into_dictionary(self) -> Dictionary {
        self.dictionary
    }

    /// Takes bytes in and gives the blocks that they complete.
    pub fn push(&mut self, bytes: &[u8], counters: &mut StreamCounters) -> Vec<Block> {
        let rest = match &mut self.state {
            State::Searching(seen) => {
                seen.extend_from_slice(bytes);
                match self.begin(counters) {
                    Some(rest) => Cow::Owned(rest),
                    None => return Vec::new(),
                }
            }
            _ => Cow::Borrowed(bytes),
        };
        self.taken += rest.len() as u64;
        self.read(&rest, counters)
    }

    /// The stream's last byte came: what was left unfinished is lost.
    pub fn finish(&mut self, counters: &mut StreamCounters) {
        match &self.state {
            State::Searching(seen) => counters.garbage_bytes += seen.len() as u64,
            State::Reading(_) => counters.lost_bytes += self.taken.saturating_sub(self.offset),
            State::Ended | State::Lost => {}
        }
        self.state = State::Ended;
    }

    /// Begins reading when the magic is there; what follows it comes back.
    fn begin(&mut self, counters: &mut StreamCounters) -> Option<Vec<u8>> {
        let State::Searching(seen) = &mut self.state else {
            return None;
        };
        let at = seen
            .windows(mcap::MAGIC.len())
            .position(|window| window == mcap::MAGIC);
        let garbage = at.unwrap_or(seen.len().saturating_sub(mcap::MAGIC.len() - 1));
        counters.garbage_bytes += garbage as u64;
        self.taken += garbage as u64;
        seen.drain(..garbage);
        at?;
        let rest = seen.split_off(mcap::MAGIC.len());
        self.taken += mcap::MAGIC.len() as u64;
        self.offset = self.taken;
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_emit_chunks(true)
            .with_record_length_limit(RECORD_LIMIT_BYTES);
        self.state = State::Reading(Box::new(LinearReader::new_with_options(options)));
        Some(rest)
    }

    fn read(&mut self, mut rest: &[u8], counters: &mut StreamCounters) -> Vec<Block> {
        let mut blocks = Vec::new();
        let State::Reading(reader) = &mut self.state else {
            if matches!(self.state, State::Lost) {
                counters.lost_bytes += rest.len() as u64;
            }
            return blocks;
        };
        let next = loop {
            match reader.next_event() {
                Some(Ok(LinearReadEvent::ReadRequest(_))) if rest.is_empty() => break None,
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let (now, later) = rest.split_at(wanted.clamp(1, rest.len()));
                    insert(reader, now);
                    rest = later;
                }
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    let (offset, len) = (self.offset, RECORD_HEAD_BYTES + data.len() as u64);
                    self.offset += len;
                    let messages = self.dictionary.unpack(opcode, data, counters);
                    if !messages.is_empty() {
                        blocks.push(Block {
                            offset,
                            len,
                            messages,
                        });
                    }
                }
                Some(Err(error)) => {
                    tracing::warn!(offset = self.offset, %error, "MCAP stream can't be read on");
                    counters.lost_bytes += self.taken.saturating_sub(self.offset);
                    break Some(State::Lost);
                }
                None => break Some(State::Ended),
            }
        };
        if let Some(state) = next {
            self.state = state;
        }
        blocks
    }
}
