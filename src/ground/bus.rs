//! Many stations: NATS JetStream carries every alarm from the station that received it to all others.
//!
//! **Out.** Every alarm that came in by another way is published to `<prefix>.alarm.<aircraft>` with
//! `Nats-Msg-Id` = alarm id, revision and completeness, so that the stream takes it once. The station's
//! own disk has it before, and a cursor says up to which row the bus has confirmed it.
//! **In.** A durable consumer per station; a message is acknowledged only when this station's disk has
//! the alarm. What comes twice, because the acknowledgement was lost too, changes nothing.
//!
//! **Trust.** JetStream confirms before it syncs, unless it is told to sync at each message
//! (`sync_interval: always`, some hundred messages a second), and a power cut takes what it had not
//! synced. So the cursor remembers the last message that was confirmed, by its number and its id, and
//! before it is moved on the stream is asked whether that message still stands there: a stream that has
//! lost its end, or was made anew, has not, even if others have filled it up meanwhile. It is then told
//! everything again. De-duplication makes that harmless.
//!
//! **Known limits.** Operators' actions stay at the station where they were taken. Alarms only; images
//! go with the aircraft's own link.

use super::store::{BusCursor, BusRow, Completeness, StoreError};
use super::{ReceiveError, Station};
use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use async_nats::jetstream::context::PublishAckFuture;
use async_nats::jetstream::message::PublishMessage;
use async_nats::jetstream::stream::{self, DiscardPolicy, RawMessageErrorKind, StorageType};
use async_nats::jetstream::{self, AckKind, Message};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::task::{JoinError, JoinSet};
use tokio_stream::StreamExt;

/// Source of alarms as the store names it; what came this way is not sent back.
pub(super) const LINK_NAME: &str = "nats";
/// Rows that are published before their confirmations are awaited.
const PAGE: u32 = 256;
/// How long JetStream remembers message ids; beyond, the stations' own stores keep order.
const DUPLICATES: Duration = Duration::from_secs(600);
/// With nothing to tell for so long, the bus is asked whether it still has everything.
const IDLE: Duration = Duration::from_secs(2);
/// Pause after a failure.
const PAUSE: Duration = Duration::from_millis(500);
/// Header that says how much of the alarm a link carried.
const COMPLETENESS: &str = "Emberfix-Completeness";
/// Messages that are taken at once.
const AT_ONCE: usize = 512;
/// How often the server says that it has nothing; by its silence a station notices that it went away and
/// came back without remembering that we wait.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// After this time an unacknowledged message comes again.
const ACK_WAIT: Duration = Duration::from_secs(10);

/// Where the bus is and who we are on it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct BusConfig {
    pub url: String,
    /// Name of this station: its consumer's.
    pub station: String,
    /// Name of the stream; its subjects are `<stream in small letters>.alarm.>`.
    pub stream: String,
    /// Domain of the JetStream that has it; a leaf node reaches it by that name only.
    pub domain: Option<String>,
    pub replicas: usize,
    pub credentials: Option<PathBuf>,
}

/// How the bus fares, for `/health`.
#[derive(Debug, Default, Serialize)]
pub(super) struct BusHealth {
    /// Alarms that the bus has confirmed.
    published: AtomicU64,
    /// Of those, the ones that it had already.
    repeated: AtomicU64,
    /// Alarms that came from it.
    received: AtomicU64,
    /// Messages that were no alarm, or one that contradicts another.
    refused: AtomicU64,
    /// Times that the bus had lost what it had confirmed, and was told again.
    pub(super) told_again: AtomicU64,
    /// Failures of the connection and of the server.
    failures: AtomicU64,
}

#[cfg(test)]
impl BusHealth {
    pub(super) fn published(&self) -> u64 {
        self.published.load(Ordering::Relaxed)
    }
}

/// Why the bus does not go on for the moment.
#[derive(Debug, thiserror::Error)]
enum BusError {
    #[error("bus {doing}: {source}")]
    Nats {
        doing: &'static str,
        source: async_nats::Error,
    },
    #[error(transparent)]
    Store(#[from] StoreError),
}

fn nats<E: Into<async_nats::Error>>(doing: &'static str) -> impl FnOnce(E) -> BusError {
    move |source| BusError::Nats {
        doing,
        source: source.into(),
    }
}

/// The program of the bus's server, for tests and measurements: from the environment, beside the test clients' Python, or from the PATH.
#[must_use]
pub fn nats_server() -> Option<PathBuf> {
    let named = std::env::var_os("EMBERFIX_NATS_SERVER").map(PathBuf::from);
    let beside = std::env::var_os("EMBERFIX_PYTHON")
        .map(|python| Path::new(&python).with_file_name("nats-server"));
    let path = std::env::var_os("PATH").unwrap_or_default();
    let on_path = std::env::split_paths(&path).map(|folder| folder.join("nats-server"));
    named
        .into_iter()
        .chain(beside)
        .chain(on_path)
        .find(|program| program.is_file())
}

/// Talks to the bus until the station stops; a bus that is not there is tried again and again.
pub(super) async fn run(station: Arc<Station>, config: BusConfig) {
    let mut stopping = station.stopping.subscribe();
    let both = async {
        tokio::join!(
            for_ever(&station, &config, Way::Out),
            for_ever(&station, &config, Way::In)
        )
    };
    tokio::select! {
        _ = both => {}
        _ = stopping.wait_for(|stop| *stop) => {}
    }
}

#[derive(Debug, Clone, Copy)]
enum Way {
    Out,
    In,
}

async fn for_ever(station: &Arc<Station>, config: &BusConfig, way: Way) {
    loop {
        let ended = match way {
            Way::Out => publish(station, config).await,
            Way::In => consume(station, config).await,
        };
        if let Err(error) = ended {
            station.bus.failures.fetch_add(1, Ordering::Relaxed);
            tracing::warn!(%error, ?way, "the bus pauses");
        }
        tokio::time::sleep(PAUSE).await;
    }
}

async fn connect(config: &BusConfig) -> Result<jetstream::Context, BusError> {
    let mut options = async_nats::ConnectOptions::new()
        .name(format!("emberfix ground {}", config.station))
        .connection_timeout(Duration::from_secs(5));
    if let Some(path) = &config.credentials {
        let text = tokio::fs::read_to_string(path)
            .await
            .map_err(nats("reads its credentials"))?;
        options = options
            .credentials(&text)
            .map_err(nats("reads its credentials"))?;
    }
    let client = options
        .connect(&config.url)
        .await
        .map_err(nats("connects"))?;
    Ok(match &config.domain {
        Some(domain) => jetstream::with_domain(client, domain),
        None => jetstream::new(client),
    })
}

async fn open(
    config: &BusConfig,
    context: &jetstream::Context,
) -> Result<stream::Stream, BusError> {
    let prefix = config.stream.to_lowercase();
    let wanted = stream::Config {
        name: config.stream.clone(),
        subjects: vec![format!("{prefix}.alarm.>")],
        storage: StorageType::File,
        // Full is refused, not made room for: nothing that is confirmed goes.
        discard: DiscardPolicy::New,
        duplicate_window: DUPLICATES,
        num_replicas: config.replicas,
        max_message_size: 64 * 1024,
        description: Some("alarms of fire, from every station to every other".to_owned()),
        ..stream::Config::default()
    };
    context
        .get_or_create_stream(wanted)
        .await
        .map_err(nats("opens its stream"))
}

// --- out -----------------------------------------------------------------------------------------

async fn publish(station: &Arc<Station>, config: &BusConfig) -> Result<(), BusError> {
    let context = connect(config).await?;
    let stream = open(config, &context).await?;
    let mut cursor = resume(station, &stream).await?;
    let mut rows = station.rows();
    loop {
        rows.mark_unchanged();
        let after = cursor.row;
        let page = station
            .with_store(move |store| store.bus_after(after, PAGE))
            .await?;
        if page.is_empty() {
            if tokio::time::timeout(IDLE, rows.changed()).await.is_err() {
                // Nothing to tell: time to see whether the bus still has what it was told.
                cursor = resume(station, &open(config, &context).await?).await?;
            }
            continue;
        }
        let mut next = cursor.clone();
        confirm(station, config, &context, &page, &mut next).await?;
        if !still_has(&stream, &cursor).await? {
            cursor = resume(station, &open(config, &context).await?).await?;
            continue;
        }
        cursor = next;
        station.writer.bus(cursor.clone()).await?;
    }
}

/// Where to go on: behind what was confirmed, if the stream still has that.
async fn resume(station: &Arc<Station>, stream: &stream::Stream) -> Result<BusCursor, BusError> {
    let info = stream
        .get_info()
        .await
        .map_err(nats("asks for its stream"))?;
    let made = info.created.unix_timestamp_nanos();
    let name = format!("{} of {made}", info.config.name);
    let cursor = station.with_store(|store| store.bus_cursor()).await?;
    if cursor.stream == name && still_has(stream, &cursor).await? {
        return Ok(cursor);
    }
    if cursor.row > 0 {
        tracing::error!(
            confirmed = cursor.sequence,
            there = info.state.last_sequence,
            "the bus has lost what it had confirmed; it is told everything again"
        );
        station.bus.told_again.fetch_add(1, Ordering::Relaxed);
    }
    Ok(BusCursor {
        stream: name,
        ..BusCursor::default()
    })
}

/// Whether the last message that was confirmed stands where it stood.
async fn still_has(stream: &stream::Stream, cursor: &BusCursor) -> Result<bool, BusError> {
    if cursor.row == 0 {
        return Ok(true);
    }
    match stream.get_raw_message(cursor.sequence).await {
        Ok(found) => {
            let id = found.headers.get(async_nats::header::NATS_MESSAGE_ID);
            Ok(id.is_some_and(|id| id.as_str() == cursor.message))
        }
        Err(error) if error.kind() == RawMessageErrorKind::NoMessageFound => {
            // At its beginning a stream may forget, if an operator has limited it; never at its end.
            let info = stream.get_info().await;
            let first = info.map_err(nats("asks for its stream"))?.state;
            Ok(cursor.sequence < first.first_sequence && first.messages > 0)
        }
        Err(error) => Err(nats("asks for a message")(error)),
    }
}

/// Publishes a page and waits until all of it is confirmed.
async fn confirm(
    station: &Arc<Station>,
    config: &BusConfig,
    context: &jetstream::Context,
    page: &[BusRow],
    cursor: &mut BusCursor,
) -> Result<(), BusError> {
    let mut waiting: Vec<(i64, String, PublishAckFuture)> = Vec::new();
    for row in page {
        let id = format!("{}/{}/{}", row.id, row.revision, word(row.completeness));
        let message = PublishMessage::build()
            .message_id(&id)
            .header(COMPLETENESS, word(row.completeness))
            .payload(row.feature.clone().into());
        let subject = format!("{}.alarm.{}", config.stream.to_lowercase(), token(&row.uav));
        let sent = context
            .send_publish(subject, message)
            .await
            .map_err(nats("publishes"))?;
        waiting.push((row.row, id, sent));
    }
    for (row, id, sent) in waiting {
        let ack = sent.await.map_err(nats("waits for a confirmation"))?;
        cursor.row = row;
        if ack.sequence > cursor.sequence {
            (cursor.sequence, cursor.message) = (ack.sequence, id);
        }
        let counter = if ack.duplicate {
            &station.bus.repeated
        } else {
            &station.bus.published
        };
        counter.fetch_add(1, Ordering::Relaxed);
    }
    Ok(())
}

/// A name as one token of a subject: what NATS gives a meaning to is written in hexadecimal.
fn token(name: &str) -> String {
    let plain = |character: char| character.is_alphanumeric() || "-_".contains(character);
    name.chars()
        .map(|character| {
            if plain(character) {
                character.to_string()
            } else {
                format!("={:x}", u32::from(character))
            }
        })
        .collect()
}

fn word(completeness: Completeness) -> &'static str {
    match completeness {
        Completeness::Full => "full",
        Completeness::Summary => "summary",
    }
}

// --- in ------------------------------------------------------------------------------------------

async fn consume(station: &Arc<Station>, config: &BusConfig) -> Result<(), BusError> {
    let context = connect(config).await?;
    let stream = open(config, &context).await?;
    let wanted = pull::Config {
        durable_name: Some(config.station.clone()),
        ack_policy: AckPolicy::Explicit,
        ack_wait: ACK_WAIT,
        deliver_policy: DeliverPolicy::All,
        max_ack_pending: 1_024,
        ..pull::Config::default()
    };
    let consumer = stream
        .get_or_create_consumer(&config.station, wanted)
        .await
        .map_err(nats("opens its consumer"))?;
    let mut messages = consumer
        .stream()
        .heartbeat(HEARTBEAT)
        .messages()
        .await
        .map_err(nats("asks for messages"))?;
    // Many at once, so that the writer has a batch; their order does not matter.
    let mut under_way: JoinSet<Result<(), BusError>> = JoinSet::new();
    while let Some(message) = messages.next().await {
        let (station, message) = (Arc::clone(station), message.map_err(nats("reads"))?);
        under_way.spawn(async move { take(&station, &message).await });
        while under_way.len() >= AT_ONCE {
            done(under_way.join_next().await)?;
        }
        while let Some(ended) = under_way.try_join_next() {
            done(Some(ended))?;
        }
    }
    Ok(())
}

fn done(ended: Option<Result<Result<(), BusError>, JoinError>>) -> Result<(), BusError> {
    match ended {
        Some(Ok(taken)) => taken,
        Some(Err(_)) | None => Ok(()),
    }
}

async fn take(station: &Arc<Station>, message: &Message) -> Result<(), BusError> {
    let said = message
        .headers
        .as_ref()
        .and_then(|headers| headers.get(COMPLETENESS));
    let completeness = match said.map(|said| said.as_str()) {
        Some("summary") => Completeness::Summary,
        _ => Completeness::Full,
    };
    match station
        .receive(&message.payload, LINK_NAME, completeness)
        .await
    {
        Ok(_) => {
            station.bus.received.fetch_add(1, Ordering::Relaxed);
        }
        // The disk fails: it has to come again.
        Err(ReceiveError::Store(error)) if !matches!(error, StoreError::Conflict { .. }) => {
            return Err(error.into());
        }
        // It will not become an alarm by coming again.
        Err(_) => {
            station.bus.refused.fetch_add(1, Ordering::Relaxed);
            return message
                .ack_with(AckKind::Term)
                .await
                .map_err(nats("refuses"));
        }
    }
    message.ack().await.map_err(nats("acknowledges"))
}

#[cfg(test)]
mod tests {
    use super::token;

    #[test]
    fn an_aircrafts_name_is_one_token_whatever_it_is() {
        assert_eq!(token("uav-1_a"), "uav-1_a");
        assert_eq!(token("a.b *>"), "a=2eb=20=2a=3e");
    }
}
