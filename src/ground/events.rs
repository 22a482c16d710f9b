//! `GET /events`: what happens, as server-sent events.
//!
//! | Event | Data | SSE id |
//! |---|---|---|
//! | `hello` | name of the store, the ground's clock; first on every stream | |
//! | `alarm` | the alarm's GeoJSON Feature | row of the store |
//! | `incident` | the incident's GeoJSON Feature | |
//! | `gone` | `{"id", "into"}`: an incident that went into another | |
//! | `upto` | `{"row"}`: everything up to this row has been told | the row |
//! | `track` | an aircraft's [`super::Ping`] | |
//! | `refused` | time, link and reason of an alarm that was not taken | |
//! | `test` | time, link and aircraft of a test alarm, which is kept nowhere | |
//! | `time` | the ground's clock, every [`PULSE`]: a client that misses it has lost the line | |
//!
//! A stream without `Last-Event-ID` begins with every incident as it stands now; with it, it tells
//! each alarm since, in order. With `?show=incidents` a stream tells incidents instead of alarms: each
//! as it is now, at most every [`GATHER`], so that a hundred screens do not cost a hundred times every
//! revision. Each stream is a cursor into the store, so a slow client costs no
//! memory and loses no alarm: it reads on where it was, or the door closes on it and it resumes.

use super::store::{Row, Store, StoreError};
use super::{Notice, Station, now};
use crate::ground::incident;
use axum::response::sse::Event;
use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, mpsc, watch};
use tokio::time::Interval;
use tokio_stream::wrappers::ReceiverStream;

/// Event streams at once.
pub(super) const MAX_STREAMS: u64 = 128;
/// How often the ground tells its time.
const PULSE: Duration = Duration::from_secs(5);
/// Events between the cursor and the socket. When full, the cursor waits; nothing is dropped.
const QUEUED: usize = 16;
/// Rows read from the store at once.
const PAGE: u32 = 128;
/// What changes within this time is told to a screen at once.
const GATHER: Duration = Duration::from_millis(200);

/// What a stream tells of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Show {
    /// Every revision of every alarm.
    #[default]
    Alarms,
    /// Incidents as they stand.
    Incidents,
}

/// What a response body is made of.
pub(super) type Events = ReceiverStream<Result<Event, Infallible>>;

/// Opens a stream; `None` when there are too many.
pub(super) fn open(
    station: &Arc<Station>,
    show: Show,
    last_event_id: Option<i64>,
) -> Option<Events> {
    let place = Place::take(Arc::clone(station))?;
    let (sender, receiver) = mpsc::channel(QUEUED);
    let stream = Stream {
        cursor: Cursor::new(station, show, last_event_id),
        newest_row: station.rows(),
        notices: station.notices.subscribe(),
        stopping: station.stopping.subscribe(),
        sender,
        place,
    };
    tokio::spawn(stream.run());
    Some(ReceiverStream::new(receiver))
}

/// One of the [`MAX_STREAMS`]; given back when dropped.
struct Place(Arc<Station>);

impl Place {
    fn take(station: Arc<Station>) -> Option<Self> {
        let taken = station.counters.streams.fetch_add(1, Ordering::Relaxed);
        let place = Self(station);
        (taken < MAX_STREAMS).then_some(place)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.counters.streams.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Where a stream is in the store.
#[derive(Debug, Clone, Copy)]
enum Cursor {
    /// Telling how things stand: incidents by row, up to the row that was newest at the start.
    Standing { after: i64, until: i64 },
    /// Telling what happens: every alarm in order.
    Following { after: i64 },
    /// Telling incidents that changed after this row.
    Incidents { after: i64 },
}

impl Cursor {
    /// An id beyond what we have is of another store: then all is told from the start.
    fn new(station: &Station, show: Show, last_event_id: Option<i64>) -> Self {
        let until = *station.rows().borrow();
        let after = last_event_id.filter(|after| (0..=until).contains(after));
        match (show, after) {
            (Show::Alarms, Some(after)) => Self::Following { after },
            (Show::Alarms, None) => Self::Standing { after: 0, until },
            (Show::Incidents, after) => Self::Incidents {
                after: after.unwrap_or(0),
            },
        }
    }

    /// The next page and where the cursor stands behind it.
    fn read(self, store: &dyn Store) -> Result<(Vec<Row>, Self), StoreError> {
        match self {
            Self::Following { after } => {
                let rows = store.told_after(after, PAGE)?;
                let after = rows.last().map_or(after, |row| row.row);
                Ok((rows, Self::Following { after }))
            }
            Self::Incidents { .. } => Ok((Vec::new(), self)),
            Self::Standing { after, until } => {
                let mut rows = store.latest_after(after, PAGE)?;
                let more = rows.len() == PAGE as usize;
                rows.retain(|row| row.row <= until);
                let next = match rows.last() {
                    Some(last) if more => Self::Standing {
                        after: last.row,
                        until,
                    },
                    _ => Self::Following { after: until },
                };
                Ok((rows, next))
            }
        }
    }
}

/// The client has gone, or the station stops.
struct Ended;

/// What a stream waits for.
enum News {
    Alarms,
    Notice(Notice),
    /// Notices that came faster than this client reads.
    Skipped,
    Pulse,
}

struct Stream {
    cursor: Cursor,
    newest_row: watch::Receiver<i64>,
    notices: broadcast::Receiver<Notice>,
    stopping: watch::Receiver<bool>,
    sender: mpsc::Sender<Result<Event, Infallible>>,
    place: Place,
}

impl Stream {
    async fn run(mut self) {
        // Either way nothing is left to do: the client resumes by itself.
        let _: Result<(), Ended> = self.tell_all().await;
    }

    async fn tell_all(&mut self) -> Result<(), Ended> {
        self.tell(hello(&self.place.0)).await?;
        let positions: Vec<String> = self
            .place
            .0
            .tracks()
            .latest()
            .filter_map(|p| serde_json::to_string(p).ok())
            .collect();
        self.tell_news().await?;
        for position in positions {
            self.tell(Event::default().event("track").data(position))
                .await?;
        }
        let mut pulse = tokio::time::interval(PULSE);
        loop {
            match self.next(&mut pulse).await? {
                News::Alarms => self.tell_news().await?,
                News::Notice(notice) => {
                    self.tell(Event::default().event(notice.kind).data(&*notice.data))
                        .await?;
                }
                News::Skipped => {}
                News::Pulse => self.tell(time()).await?,
            }
        }
    }

    async fn next(&mut self, pulse: &mut Interval) -> Result<News, Ended> {
        let stopped = async { drop(self.stopping.wait_for(|stop| *stop).await) };
        tokio::select! {
            () = stopped => Err(Ended),
            () = self.sender.closed() => Err(Ended),
            changed = self.newest_row.changed() => changed.map(|()| News::Alarms).map_err(|_| Ended),
            notice = self.notices.recv() => match notice {
                Ok(notice) => Ok(News::Notice(notice)),
                Err(RecvError::Lagged(_)) => Ok(News::Skipped),
                Err(RecvError::Closed) => Err(Ended),
            },
            _ = pulse.tick() => Ok(News::Pulse),
        }
    }

    /// Tells every incident that changed since the cursor, each as it is now.
    async fn tell_incidents(&mut self, mut after: i64) -> Result<(), Ended> {
        let until = *self.newest_row.borrow_and_update();
        loop {
            let news = self.place.0.incidents_since(after, PAGE as usize);
            let Some(last) = news.last() else { break };
            after = last.row();
            for news in &news {
                self.tell(told(news)).await?;
            }
            // What changes meanwhile is told in the next round: a busy ground must not run this for ever.
            if after >= until {
                break;
            }
        }
        after = after.max(until);
        self.cursor = Cursor::Incidents { after };
        let data = serde_json::json!({ "row": after }).to_string();
        let upto = Event::default().event("upto").id(after.to_string());
        self.tell(upto.data(data)).await?;
        tokio::time::sleep(GATHER).await;
        Ok(())
    }

    /// Tells everything from the cursor to the end of the store.
    async fn tell_news(&mut self) -> Result<(), Ended> {
        match self.cursor {
            Cursor::Incidents { after } => self.tell_incidents(after).await,
            Cursor::Standing { .. } | Cursor::Following { .. } => self.tell_alarms().await,
        }
    }

    async fn tell_alarms(&mut self) -> Result<(), Ended> {
        self.newest_row.mark_unchanged();
        loop {
            let cursor = self.cursor;
            let page = self
                .place
                .0
                .with_store(move |store| cursor.read(store))
                .await;
            let (rows, next) = page.map_err(|error| {
                tracing::error!(%error, "an event stream ends");
                Ended
            })?;
            self.cursor = next;
            let standing = matches!(cursor, Cursor::Standing { .. });
            if rows.is_empty() && !standing {
                return Ok(());
            }
            for row in rows {
                let event = Event::default().event("alarm").id(row.row.to_string());
                self.tell(event.data(row.feature)).await?;
            }
        }
    }

    async fn tell(&self, event: Event) -> Result<(), Ended> {
        self.sender.send(Ok(event)).await.map_err(|_| Ended)
    }
}

fn hello(station: &Station) -> Event {
    let data = serde_json::json!({ "store": station.store.id(), "now": now().rfc3339() });
    Event::default().event("hello").data(data.to_string())
}

fn time() -> Event {
    let data = serde_json::json!({ "now": now().rfc3339() });
    Event::default().event("time").data(data.to_string())
}

fn told(news: &incident::News) -> Event {
    match news {
        incident::News::Changed(incident) => Event::default()
            .event("incident")
            .data(&*incident.feature()),
        incident::News::Gone { id, into, .. } => {
            let data = serde_json::json!({ "id": id, "into": into });
            Event::default().event("gone").data(data.to_string())
        }
    }
}
