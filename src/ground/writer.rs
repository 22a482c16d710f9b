//! The one that writes: a thread that takes what came from a queue, as much as there is, and puts it
//! on disk with one sync. Nobody is answered before that.
//!
//! Bounds: [`QUEUED`] jobs wait, at most [`MAX_BATCH`] go into one commit. Loss: none is dropped;
//! who finds the queue full for [`PATIENCE`] is told so and tries again.

use super::action::{Action, Kind};
use super::board::Board;
use super::book::{Book, Came, MAX_ALARMS};
use super::incident::{Incident, News};
use super::store::{
    Batch, BusCursor, Delivery, Kept, Latest, NewAction, NewAlarm, Rank, Standing, Store,
    StoreError,
};
use crate::alarm::Alarm;
use emberfix_frames::{ServiceTime, Wgs84Parts};
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot, watch};

/// Jobs that wait.
const QUEUED: usize = 4_096;
/// Jobs of one commit.
const MAX_BATCH: usize = 1_024;
/// How long somebody waits for a place in the queue.
const PATIENCE: Duration = Duration::from_secs(2);
/// Incidents that are loaded at the start.
const LOADED: u32 = 5_000;

/// What everyone may see of the writer's work, only ever after it is on disk.
#[derive(Debug)]
pub(super) struct Published {
    pub board: RwLock<Board>,
    /// Newest row of the journal.
    pub newest_row: watch::Sender<i64>,
}

/// What an operator orders.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Order {
    /// The client's own id of it.
    pub key: String,
    /// What.
    pub kind: Kind,
    /// To which incident.
    pub incident: String,
    /// Merge: the other incident. Split: the alarm that leaves. Undo: the action's number.
    pub with: Option<String>,
    /// Who.
    pub by: String,
    /// In their words.
    pub note: Option<String>,
    /// By the ground's clock.
    pub at: ServiceTime,
}

/// Why an order was not carried out.
#[derive(Debug, thiserror::Error)]
pub enum OrderError {
    /// No such incident.
    #[error("there is no incident {id}")]
    NoIncident {
        /// What was asked for.
        id: String,
    },
    /// `with` does not name what the action needs.
    #[error("{kind} needs `with` to be {allowed}; it is {with:?}", kind = kind.name())]
    With {
        /// The action.
        kind: Kind,
        /// What stood there.
        with: Option<String>,
        /// What would have been accepted.
        allowed: &'static str,
    },
    /// The client's id was used for something else.
    #[error("id {key:?} was used for action {number}, which is another one")]
    Key {
        /// The client's id.
        key: String,
        /// Number of the action that has it.
        number: i64,
    },
    /// It could not be recorded.
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// An order that was carried out.
#[derive(Debug, Clone)]
pub struct Done {
    /// As it is on record.
    pub action: Action,
    /// It had been carried out before.
    pub again: bool,
}

#[derive(Debug)]
enum Job {
    Keep(Box<Delivery>, oneshot::Sender<Result<Kept, StoreError>>),
    Act(Box<Order>, oneshot::Sender<Result<Done, OrderError>>),
    Fetched {
        uav: String,
        number: i64,
        at: ServiceTime,
    },
    Chip {
        alarm: String,
    },
    Bus(BusCursor, oneshot::Sender<Result<(), StoreError>>),
}

/// The way to the writer.
#[derive(Debug, Clone)]
pub(super) struct Writer {
    jobs: mpsc::Sender<Job>,
}

impl Writer {
    /// Loads what is on disk and starts the thread.
    ///
    /// # Errors
    /// [`StoreError`] when the store can't be read.
    pub fn start(
        store: Arc<dyn Store>,
        exercise: bool,
        has_chip: HasChip,
    ) -> Result<(Self, Arc<Published>), StoreError> {
        let published = Arc::new(Published {
            board: RwLock::default(),
            newest_row: watch::Sender::new(store.newest_row()?),
        });
        let (jobs, queue) = mpsc::channel(QUEUED);
        let mut scribe = Scribe::new(store, Arc::clone(&published), exercise, has_chip);
        scribe.load()?;
        let thread = std::thread::Builder::new().name("ground-writer".to_owned());
        thread
            .spawn(move || scribe.run(queue))
            .map_err(|source| StoreError::Batch {
                reason: source.to_string(),
            })?;
        Ok((Self { jobs }, published))
    }

    /// Keeps a delivery. On `Ok` it is on disk; [`Kept::Again`] when it already was.
    ///
    /// # Errors
    /// [`StoreError`]; nothing was kept then.
    pub async fn keep(&self, delivery: Delivery) -> Result<Kept, StoreError> {
        let (answer, answered) = oneshot::channel();
        self.send(Job::Keep(Box::new(delivery), answer)).await?;
        answered.await.unwrap_or(Err(StoreError::Stopped))
    }

    /// Carries out an order. On `Ok` it is on disk.
    ///
    /// # Errors
    /// [`OrderError`]; nothing was done then.
    pub async fn act(&self, order: Order) -> Result<Done, OrderError> {
        let (answer, answered) = oneshot::channel();
        self.send(Job::Act(Box::new(order), answer)).await?;
        answered
            .await
            .unwrap_or(Err(OrderError::Store(StoreError::Stopped)))
    }

    /// Notes that an aircraft has fetched every action up to a number.
    pub async fn fetched(
        &self,
        uav: String,
        number: i64,
        at: ServiceTime,
    ) -> Result<(), StoreError> {
        self.send(Job::Fetched { uav, number, at }).await
    }

    /// Notes that there is an image of an alarm.
    pub fn chip(&self, alarm: String) {
        // When the queue is full the image shows with the incident's next change.
        let _ = self.jobs.try_send(Job::Chip { alarm });
    }

    /// Notes where the bus is.
    ///
    /// # Errors
    /// [`StoreError`]; nothing was kept then.
    pub async fn bus(&self, cursor: BusCursor) -> Result<(), StoreError> {
        let (answer, answered) = oneshot::channel();
        self.send(Job::Bus(cursor, answer)).await?;
        answered.await.unwrap_or(Err(StoreError::Stopped))
    }

    async fn send(&self, job: Job) -> Result<(), StoreError> {
        use mpsc::error::SendTimeoutError;
        self.jobs
            .send_timeout(job, PATIENCE)
            .await
            .map_err(|error| match error {
                SendTimeoutError::Timeout(_) => StoreError::Busy { waiting: QUEUED },
                SendTimeoutError::Closed(_) => StoreError::Stopped,
            })
    }

    /// Jobs that wait.
    pub fn waiting(&self) -> usize {
        self.jobs.max_capacity() - self.jobs.capacity()
    }
}

/// Whether there is an image of an alarm.
pub(super) type HasChip = Box<dyn Fn(&str) -> bool + Send>;

/// Somebody who waits for the commit.
enum Waiting {
    Keep(
        oneshot::Sender<Result<Kept, StoreError>>,
        Result<Kept, StoreError>,
    ),
    Act(
        oneshot::Sender<Result<Done, OrderError>>,
        Result<Done, OrderError>,
    ),
    Bus(oneshot::Sender<Result<(), StoreError>>),
}

struct Scribe {
    store: Arc<dyn Store>,
    published: Arc<Published>,
    exercise: bool,
    has_chip: HasChip,
    /// The book is not what is on disk: it has to be read anew before anything else is taken.
    stale: bool,
    book: Book,
    row: i64,
    action: i64,
    batch: Batch,
    /// Revisions of this batch, which the store does not have yet.
    fresh: HashMap<(String, Rank), Alarm>,
    news: Vec<News>,
    waiting: Vec<Waiting>,
}

impl Scribe {
    fn new(
        store: Arc<dyn Store>,
        published: Arc<Published>,
        exercise: bool,
        has_chip: HasChip,
    ) -> Self {
        Self {
            store,
            published,
            exercise,
            has_chip,
            stale: false,
            book: Book::new(exercise),
            row: 0,
            action: 0,
            batch: Batch::default(),
            fresh: HashMap::new(),
            news: Vec::new(),
            waiting: Vec::new(),
        }
    }

    fn run(mut self, mut queue: mpsc::Receiver<Job>) {
        while let Some(job) = queue.blocking_recv() {
            self.take(job);
            for _ in 1..MAX_BATCH {
                match queue.try_recv() {
                    Ok(job) => self.take(job),
                    Err(_) => break,
                }
            }
            self.finish();
        }
    }

    // --- loading -------------------------------------------------------------------------------

    fn load(&mut self) -> Result<(), StoreError> {
        self.row = self.store.newest_row()?;
        self.action = self.store.newest_action()?;
        let mut loaded = self.store.load(LOADED)?;
        loaded.latest.sort_by_key(|latest| latest.first_row);
        self.book = Book::new(self.exercise);
        if loaded.more {
            self.book.forgets();
        }
        let mut orphans = Vec::new();
        for latest in loaded.latest {
            self.load_alarm(latest, &mut orphans);
        }
        for action in &loaded.actions {
            self.book.remember(action);
        }
        for (uav, number) in loaded.fetched {
            self.book.fetched(&uav, number, 0);
        }
        let with_chip: Vec<String> = self
            .book
            .alarm_ids()
            .filter(|id| (self.has_chip)(id))
            .map(str::to_owned)
            .collect();
        for alarm in with_chip {
            self.book.has_chip(&alarm, 0);
        }
        let standing = self.book.loaded(&loaded.rows);
        let gone = loaded
            .gone
            .into_iter()
            .map(|(id, row, into)| News::Gone { row, id, into });
        self.publish(gone.chain(standing).collect());
        self.adopt(orphans)
    }

    fn load_alarm(&mut self, latest: Latest, orphans: &mut Vec<(Came, Latest)>) {
        let alarm = match Alarm::from_geojson(latest.feature.as_bytes()) {
            Ok(alarm) => alarm,
            Err(error) => {
                tracing::error!(%error, id = latest.id, "an alarm on disk can't be read; it is left out");
                return;
            }
        };
        let came = Came {
            alarm,
            rank: latest.rank,
            row: latest.row,
        };
        match &latest.incident {
            Some(home) => self
                .book
                .load(came, latest.first_row, latest.revisions, home),
            None => orphans.push((came, latest)),
        }
    }

    /// Merges what an older program left unmerged, and writes that down.
    fn adopt(&mut self, orphans: Vec<(Came, Latest)>) -> Result<(), StoreError> {
        for (came, latest) in orphans {
            let news = self.book.adopt(came, latest.first_row, latest.revisions);
            self.news.extend(news);
        }
        self.commit()
    }

    // --- taking --------------------------------------------------------------------------------

    fn take(&mut self, job: Job) {
        match job {
            Job::Keep(delivery, answer) => {
                let kept = self.keep(*delivery);
                self.waiting.push(Waiting::Keep(answer, kept));
            }
            Job::Act(order, answer) => {
                let done = self.act(&order);
                self.waiting.push(Waiting::Act(answer, done));
            }
            // Neither is worth a word while the disk fails: both are said again.
            Job::Fetched { .. } | Job::Chip { .. } if self.stale => {}
            Job::Fetched { uav, number, at } => self.fetched(uav, number, at),
            Job::Chip { alarm } => {
                let row = self.row + 1;
                let news = self.book.has_chip(&alarm, row);
                self.row += i64::from(!news.is_empty());
                self.news.extend(news);
            }
            Job::Bus(cursor, answer) => {
                self.batch.bus = Some(cursor);
                self.waiting.push(Waiting::Bus(answer));
            }
        }
    }

    fn keep(&mut self, delivery: Delivery) -> Result<Kept, StoreError> {
        self.freshen()?;
        let rank = delivery.rank();
        let id = &delivery.alarm.properties.id;
        self.recall(id)?;
        let newest = self.book.entry(id).map(|entry| entry.rank);
        let tells = newest.is_none_or(|newest| rank > newest);
        if !tells && self.is_known(&delivery, rank)? {
            return Ok(Kept::Again);
        }
        self.row += 1;
        let row = self.row;
        let news = if tells {
            let alarm = delivery.alarm.clone();
            self.book.take(Came { alarm, rank, row })
        } else {
            self.book.count(id, row)
        };
        self.news.extend(news);
        self.fresh
            .insert((id.clone(), rank), delivery.alarm.clone());
        self.batch.alarms.push(NewAlarm {
            row,
            delivery,
            tells,
        });
        Ok(Kept::New { row, tells })
    }

    /// Brings an incident back into a book that has forgotten it.
    fn recall(&mut self, id: &str) -> Result<(), StoreError> {
        if !self.book.is_forgetful() || self.book.entry(id).is_some() {
            return Ok(());
        }
        let mut orphans = Vec::new();
        for latest in self.store.recall(id)? {
            self.load_alarm(latest, &mut orphans);
        }
        Ok(())
    }

    /// Whether this revision is on record: as it is, or, for a summary, in full.
    fn is_known(&self, delivery: &Delivery, rank: Rank) -> Result<bool, StoreError> {
        let properties = &delivery.alarm.properties;
        let mut known: Vec<(Alarm, bool)> = Vec::new();
        for full in [true, false] {
            let fresh = self
                .fresh
                .get(&(properties.id.clone(), Rank { full, ..rank }));
            known.extend(fresh.map(|alarm| (alarm.clone(), full)));
        }
        for (feature, full) in self.store.revision(&properties.id, rank.revision)? {
            match Alarm::from_geojson(feature.as_bytes()) {
                Ok(alarm) => known.push((alarm, full)),
                Err(_) if full == rank.full => return Ok(true),
                Err(_) => {}
            }
        }
        // The whole alarm replaces a summary, so for it only another whole one counts.
        let Some((known, full)) = known.into_iter().find(|(_, full)| *full || !rank.full) else {
            return Ok(false);
        };
        if full && !rank.full || same_alarm(&known, &delivery.alarm, rank.full) {
            return Ok(true);
        }
        Err(StoreError::Conflict {
            id: properties.id.clone(),
            revision: rank.revision,
            captured_at: properties.captured_at,
            known_captured_at: known.properties.captured_at,
        })
    }

    fn fetched(&mut self, uav: String, number: i64, at: ServiceTime) {
        let number = number.min(self.action);
        if number <= self.book.fetched_by(&uav) {
            return;
        }
        let news = self.book.fetched(&uav, number, self.row + 1);
        self.row += i64::from(!news.is_empty());
        self.news.extend(news);
        self.batch.fetched.insert(uav, (number, at));
    }

    // --- operators -----------------------------------------------------------------------------

    fn act(&mut self, order: &Order) -> Result<Done, OrderError> {
        self.freshen()?;
        if let Some(action) = self.known_action(&order.key)? {
            return again(action, order);
        }
        let (alarms, others, of) = self.meant(order)?;
        let (number, row) = (self.action + 1, self.row + 1);
        let action = Action {
            number,
            row,
            key: order.key.clone(),
            kind: order.kind,
            incident: order.incident.clone(),
            alarms,
            others,
            of,
            by: order.by.clone(),
            at: order.at,
            note: order.note.clone(),
            undone: false,
        };
        (self.action, self.row) = (number, row);
        let news = self.book.act(&action);
        self.news.extend(news);
        self.batch.undone.extend(of);
        let tell = self.aircraft_of(&action);
        self.batch.actions.push(NewAction {
            action: action.clone(),
            tell,
        });
        Ok(Done {
            action,
            again: false,
        })
    }

    fn known_action(&self, key: &str) -> Result<Option<Action>, StoreError> {
        let fresh = self.batch.actions.iter().find(|new| new.action.key == key);
        match fresh {
            Some(new) => Ok(Some(new.action.clone())),
            None => self.store.action_by_key(key),
        }
    }

    fn aircraft_of(&self, action: &Action) -> Vec<(String, String)> {
        let alarms = action.alarms.iter().chain(&action.others);
        let known = alarms.filter_map(|id| Some((id, self.book.entry(id)?)));
        known
            .map(|(id, entry)| (id.clone(), entry.alarm.properties.uav.clone()))
            .collect()
    }

    /// Alarms that are meant, the others, and the action that is taken back.
    #[expect(
        clippy::type_complexity,
        reason = "three parts of one record, taken apart at once"
    )]
    fn meant(
        &mut self,
        order: &Order,
    ) -> Result<(Vec<String>, Vec<String>, Option<i64>), OrderError> {
        let with = |allowed| OrderError::With {
            kind: order.kind,
            with: order.with.clone(),
            allowed,
        };
        let alarms = self.alarms_of(&order.incident)?;
        let name = order.with.as_deref().unwrap_or_default();
        match order.kind {
            Kind::Acknowledge | Kind::Confirm | Kind::Dismiss => Ok((alarms, Vec::new(), None)),
            Kind::Merge => {
                let others = self
                    .alarms_of(name)
                    .map_err(|_| with("another incident's id"))?;
                if others == alarms {
                    return Err(with("another incident's id"));
                }
                Ok((alarms, others, None))
            }
            Kind::Split => {
                let (leaving, staying): (Vec<_>, Vec<_>) =
                    alarms.into_iter().partition(|alarm| alarm == name);
                if leaving.is_empty() || staying.is_empty() {
                    return Err(with("one of several alarms of the incident"));
                }
                Ok((leaving, staying, None))
            }
            Kind::Undo => {
                let of = name
                    .parse()
                    .ok()
                    .and_then(|number| self.book.action(number));
                let undoable = |action: &&Action| !action.undone && action.kind != Kind::Undo;
                let of = of
                    .filter(undoable)
                    .ok_or_else(|| with("the number of an action that stands"))?;
                Ok((of.alarms.clone(), of.others.clone(), Some(of.number)))
            }
        }
    }

    fn alarms_of(&mut self, incident: &str) -> Result<Vec<String>, OrderError> {
        self.recall(incident)?;
        let home = self
            .book
            .home(incident)
            .and_then(|id| self.book.alarms_of(id));
        home.map(<[String]>::to_vec)
            .ok_or_else(|| OrderError::NoIncident {
                id: incident.to_owned(),
            })
    }

    // --- finishing -----------------------------------------------------------------------------

    /// Reads the book anew when the disk has failed.
    fn freshen(&mut self) -> Result<(), StoreError> {
        if self.stale {
            self.load()?;
            self.stale = false;
        }
        Ok(())
    }

    /// Commits and answers. When the disk fails, nobody is told that anything was kept, and the book
    /// is read anew.
    fn finish(&mut self) {
        let committed = self.commit();
        if let Err(error) = &committed {
            tracing::error!(%error, "nothing of a batch was kept");
            self.stale = true;
        }
        let reason = committed.err().map(|error| error.to_string());
        for waiting in self.waiting.drain(..) {
            waiting.answer(reason.as_deref());
        }
    }

    fn commit(&mut self) -> Result<(), StoreError> {
        for alarm in self.book.take_dirty() {
            if let Some(latest) = self.latest(&alarm) {
                self.batch.latest.insert(alarm, latest);
            }
        }
        let news = std::mem::take(&mut self.news);
        let newest: BTreeMap<&str, &News> = news.iter().map(|news| (news.id(), news)).collect();
        self.batch.incidents = newest
            .into_values()
            .filter_map(|news| Some((news.id().to_owned(), standing(news)?)))
            .collect();
        let batch = std::mem::take(&mut self.batch);
        self.fresh.clear();
        if !batch.is_empty() {
            self.store.commit(&batch)?;
        }
        self.publish(news);
        Ok(())
    }

    fn latest(&self, alarm: &str) -> Option<Latest> {
        let entry = self.book.entry(alarm)?;
        Some(Latest {
            id: alarm.to_owned(),
            row: entry.row,
            rank: entry.rank,
            first_row: entry.first_row,
            revisions: entry.revisions,
            incident: Some(entry.incident.clone()),
            feature: String::new(),
        })
    }

    fn publish(&mut self, news: Vec<News>) {
        let left = self.book.make_room();
        {
            let board = &self.published.board;
            let mut board = board.write().unwrap_or_else(PoisonError::into_inner);
            for news in news {
                board.apply(news);
            }
            for id in left {
                board.forget(&id);
            }
        }
        let row = self.row;
        self.published.newest_row.send_if_modified(|newest| {
            let newer = row > *newest;
            *newest = row.max(*newest);
            newer
        });
    }
}

/// An order that came before: done, unless the key was used for another one.
fn again(action: Action, order: &Order) -> Result<Done, OrderError> {
    if action.kind == order.kind && action.incident == order.incident {
        return Ok(Done {
            action,
            again: true,
        });
    }
    Err(OrderError::Key {
        key: order.key.clone(),
        number: action.number,
    })
}

impl Waiting {
    fn answer(self, failed: Option<&str>) {
        let failure = || {
            failed.map(|reason| StoreError::Batch {
                reason: reason.to_owned(),
            })
        };
        // Who has gone meanwhile will ask again.
        match self {
            Self::Keep(answer, kept) => {
                drop(answer.send(match failure() {
                    Some(error) if kept.is_ok() => Err(error),
                    _ => kept,
                }));
            }
            Self::Act(answer, done) => {
                drop(answer.send(match failure() {
                    Some(error) if done.is_ok() => Err(error.into()),
                    _ => done,
                }));
            }
            Self::Bus(answer) => drop(answer.send(failure().map_or(Ok(()), Err))),
        }
    }
}

/// What the store keeps of a change.
fn standing(news: &News) -> Option<Standing> {
    match news {
        News::Changed(incident) => Some(of_incident(incident)),
        News::Gone { row, id, into } => Some(Standing {
            id: id.clone(),
            row: *row,
            into: Some(into.clone()),
            latitude_deg: 0.0,
            longitude_deg: 0.0,
            first_seen_at: ServiceTime::from_unix_ns(0),
            captured_at: ServiceTime::from_unix_ns(0),
            feature: String::new(),
        }),
    }
}

fn of_incident(incident: &Incident) -> Standing {
    Standing {
        id: incident.id.clone(),
        row: incident.row,
        into: None,
        latitude_deg: incident.place.latitude_deg(),
        longitude_deg: incident.place.longitude_deg(),
        first_seen_at: incident.first_seen_at,
        captured_at: incident.captured_at,
        feature: incident.feature().to_string(),
    }
}

/// Whether two deliveries of one id and revision are one alarm. A summary has no capture time of
/// its own; its position is repeated to the last bit.
fn same_alarm(known: &Alarm, new: &Alarm, full: bool) -> bool {
    if full {
        known.properties.captured_at == new.properties.captured_at
    } else {
        known.place == new.place
    }
}

const _: () = assert!(LOADED as usize <= MAX_ALARMS);
