//! What every store promises, held against each of them; and the old layout brought up to date.

use super::postgres::Postgres;
use super::server::Server;
use super::sqlite::Sqlite;
use super::*;
use crate::ground::action::Kind;
use crate::ground::incident::OperatorState;
use crate::ground::writer::{Order, OrderError, Published, Writer};
use crate::ground::{Incident, News, database_in};
use std::sync::Arc;
use std::task::{Context, Wake, Waker};

pub fn feature(id: &str, revision: u32, captured_at: &str) -> String {
    format!(
        r#"{{"type":"Feature","geometry":{{"type":"Point","coordinates":[119.112017,31.409422,18.5]}},
        "properties":{{"id":"{id}","revision":{revision},"uav":"gaochun","class":"fire",
        "state":"confirmed","confidence":0.93,"first_seen_at":"2026-03-01T12:00:00Z",
        "captured_at":"{captured_at}","altitude_msl_m":10.1,"height_above_ground_m":null,
        "ce90_m":2.6,"le90_m":2.1,"covariance_enu_m2":[1.6,0.3,0,0.3,1.3,0,0,0,1.6],
        "methods":["stereo"],"sightings":5,"range_m":22.4,"size_m":null,"trend":null,
        "degraded":[]}}}}"#
    )
}

/// A station's store with its writer, as the ground opens it.
pub(in crate::ground) struct Kit {
    pub store: Arc<dyn Store>,
    pub writer: Writer,
    pub published: Arc<Published>,
}

impl Kit {
    pub fn open(store: Arc<dyn Store>) -> Self {
        let (writer, published) =
            Writer::start(Arc::clone(&store), false, Box::new(|_| false)).unwrap();
        Self {
            store,
            writer,
            published,
        }
    }

    pub async fn keep(&self, delivery: Delivery) -> Result<Kept, StoreError> {
        self.writer.keep(delivery).await
    }

    fn incidents(&self) -> Vec<Arc<Incident>> {
        self.published
            .board
            .read()
            .unwrap()
            .all()
            .cloned()
            .collect()
    }

    fn incident(&self, id: &str) -> Option<Arc<Incident>> {
        self.published.board.read().unwrap().get(id).cloned()
    }

    fn since(&self, row: i64) -> Vec<News> {
        self.published.board.read().unwrap().since(row, 100)
    }

    fn told(&self) -> Vec<u32> {
        let rows = self.store.latest_after(0, 10).unwrap();
        let revision = |row: Row| {
            Alarm::from_geojson(row.feature.as_bytes())
                .unwrap()
                .properties
                .revision
        };
        rows.into_iter().map(revision).collect()
    }

    async fn order(
        &self,
        key: &str,
        kind: Kind,
        incident: &str,
        with: Option<&str>,
    ) -> Result<crate::ground::Done, OrderError> {
        let order = Order {
            key: key.to_owned(),
            kind,
            incident: incident.to_owned(),
            with: with.map(str::to_owned),
            by: "duty officer".to_owned(),
            note: None,
            at: ServiceTime::from_unix_ns(1_772_366_400_000_000_000),
        };
        self.writer.act(order).await
    }
}

fn delivery(revision: u32, completeness: Completeness) -> Delivery {
    let raw = feature(
        "gaochun-1",
        revision,
        &format!("2026-03-01T12:00:{revision:02}Z"),
    );
    delivery_of(raw, completeness)
}

fn delivery_of(raw: String, completeness: Completeness) -> Delivery {
    Delivery {
        alarm: Alarm::from_geojson(raw.as_bytes()).unwrap(),
        raw,
        received_at: ServiceTime::from_unix_ns(0),
        link: "test",
        completeness,
    }
}

/// Another aircraft's alarm, so many metres east.
fn from(uav: &str, fire: u32, revision: u32, east_m: f64) -> Delivery {
    let raw = feature(
        &format!("{uav}-{fire}"),
        revision,
        &format!("2026-03-01T12:01:{revision:02}Z"),
    );
    // 95.03 km per degree of longitude at 31.41 degrees north.
    let longitude = 119.112017 + east_m / 95_030.0;
    let raw = raw
        .replace("119.112017", &longitude.to_string())
        .replace("\"gaochun\"", &format!("\"{uav}\""));
    delivery_of(raw, Completeness::Full)
}

/// A place for the test's life and a way to open the same store in it again and again.
pub(in crate::ground) struct Place {
    open: Box<dyn Fn() -> Arc<dyn Store>>,
}

impl Place {
    pub fn kit(&self) -> Kit {
        Kit::open((self.open)())
    }
}

fn sqlite() -> Place {
    let folder = tempfile::tempdir().unwrap();
    Place {
        open: Box::new(move || Arc::new(Sqlite::open(folder.path()).unwrap())),
    }
}

fn postgres(server: &Server, name: &str) -> Place {
    let url = server.database(name);
    Place {
        open: Box::new(move || Arc::new(Postgres::open(&url, None).unwrap())),
    }
}

/// Runs a future on this thread, where the PostgreSQL client may block as it does in the writer's
/// thread; clocks and tasks belong to a runtime beside it.
fn block_on(future: impl Future) {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let _inside = runtime.enter();
    let waker = Waker::from(Arc::new(Unpark(std::thread::current())));
    let mut future = std::pin::pin!(future);
    while future
        .as_mut()
        .poll(&mut Context::from_waker(&waker))
        .is_pending()
    {
        std::thread::park();
    }
}

struct Unpark(std::thread::Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

/// Runs each check over each store that this machine has.
macro_rules! contract {
    ($($name:ident)*) => {
        mod on_sqlite {
            $(#[tokio::test] async fn $name() { super::$name(super::sqlite()).await })*
        }

        #[test]
        fn all_of_it_on_postgresql_with_postgis() {
            let server = match Server::start() {
                Ok(server) => server,
                Err(reason) => {
                    println!("skipped: {reason}");
                    return;
                }
            };
            $(
                println!("{}", stringify!($name));
                block_on($name(postgres(&server, stringify!($name))));
            )*
            over_tls_only_the_authoritys_server_is_believed(&server);
        }
    };
}

contract! {
    a_repeated_delivery_is_acknowledged_and_changes_nothing
    an_older_revision_is_kept_as_history_and_never_shown
    a_summary_never_replaces_the_whole_alarm_but_a_newer_one_shows
    an_aircraft_that_restarts_its_numbering_is_refused_not_swallowed
    a_restart_keeps_everything_and_goes_on_counting
    two_aircraft_make_one_incident_and_part_when_contradicted
    operators_are_recorded_once_and_told_to_the_aircraft
    operators_merge_and_split_and_take_it_back
    area_and_time_find_what_is_there
    a_batch_is_kept_whole_or_not_at_all
}

fn over_tls_only_the_authoritys_server_is_believed(server: &Server) {
    println!("over TLS");
    let (url, ours, others) = server.over_tls("tls");
    let store = Postgres::open(&url, Some(&ours)).unwrap();
    assert_eq!(store.census().unwrap().alarms, 0);
    assert!(store.is_over_tls().unwrap());
    let refused = Postgres::open(&url, Some(&others)).unwrap_err();
    assert!(refused.to_string().contains("certificate"), "{refused}");
    let another_name = url.replace("localhost", "elsewhere.example");
    assert!(Postgres::open(&another_name, Some(&ours)).is_err());
    // A server that has no TLS gets no password in the clear.
    let plain = server.database("plain");
    assert!(Postgres::open(&plain, Some(&ours)).is_err());
}

async fn a_repeated_delivery_is_acknowledged_and_changes_nothing(place: Place) {
    let kit = place.kit();
    let first = kit.keep(delivery(1, Completeness::Full)).await.unwrap();
    assert_eq!(
        first,
        Kept::New {
            row: 1,
            tells: true
        }
    );
    let again = kit.keep(delivery(1, Completeness::Full)).await.unwrap();
    assert_eq!(again, Kept::Again);
    assert_eq!(
        kit.store.census().unwrap(),
        Census {
            incidents: 1,
            alarms: 1
        }
    );
    // Both at once, in one batch or in two.
    let both = tokio::join!(
        kit.keep(delivery(2, Completeness::Full)),
        kit.keep(delivery(2, Completeness::Full))
    );
    let both = [both.0.unwrap(), both.1.unwrap()];
    assert!(
        both.contains(&Kept::Again)
            && both.contains(&Kept::New {
                row: 2,
                tells: true
            })
    );
}

async fn an_older_revision_is_kept_as_history_and_never_shown(place: Place) {
    let kit = place.kit();
    kit.keep(delivery(3, Completeness::Full)).await.unwrap();
    let late = kit.keep(delivery(2, Completeness::Full)).await.unwrap();
    assert_eq!(
        late,
        Kept::New {
            row: 2,
            tells: false
        }
    );
    assert_eq!(kit.told(), [3]);
    assert_eq!(kit.store.told_after(0, 10).unwrap().len(), 1);
    assert_eq!(kit.store.census().unwrap().alarms, 2);
    let incident = kit.incident("gaochun-1").unwrap();
    assert_eq!((incident.alarms[0].revision, incident.history), (3, 2));
    let history = kit.store.history(&["gaochun-1".to_owned()], 10).unwrap();
    assert_eq!(
        history.iter().map(|line| line.row).collect::<Vec<_>>(),
        [2, 1]
    );
}

async fn a_summary_never_replaces_the_whole_alarm_but_a_newer_one_shows(place: Place) {
    let kit = place.kit();
    kit.keep(delivery(1, Completeness::Summary)).await.unwrap();
    let fuller = kit.keep(delivery(1, Completeness::Full)).await.unwrap();
    assert_eq!(
        fuller,
        Kept::New {
            row: 2,
            tells: true
        }
    );
    assert_eq!(
        kit.keep(delivery(1, Completeness::Summary)).await.unwrap(),
        Kept::Again
    );
    assert_eq!(kit.store.latest_after(0, 10).unwrap()[0].row, 2);
    kit.keep(delivery(2, Completeness::Summary)).await.unwrap();
    assert_eq!(kit.told(), [2]);
}

async fn an_aircraft_that_restarts_its_numbering_is_refused_not_swallowed(place: Place) {
    let kit = place.kit();
    kit.keep(delivery(1, Completeness::Full)).await.unwrap();
    let another = feature("gaochun-1", 1, "2026-03-02T08:00:00Z");
    let refused = kit
        .keep(delivery_of(another, Completeness::Full))
        .await
        .unwrap_err();
    assert!(
        matches!(refused, StoreError::Conflict { revision: 1, .. }),
        "{refused}"
    );
    assert!(refused.to_string().contains("another name"));
}

async fn a_restart_keeps_everything_and_goes_on_counting(place: Place) {
    let kit = place.kit();
    kit.keep(delivery(1, Completeness::Full)).await.unwrap();
    kit.keep(from("b", 7, 1, 1.0)).await.unwrap();
    kit.order("k", Kind::Acknowledge, "gaochun-1", None)
        .await
        .unwrap();
    kit.writer
        .fetched("b".to_owned(), 1, ServiceTime::from_unix_ns(0))
        .await
        .unwrap();
    kit.keep(from("c", 1, 1, 300.0)).await.unwrap();
    let before = kit.incidents();
    let id = kit.store.id().to_owned();
    drop(kit);
    let kit = place.kit();
    assert_eq!(kit.store.id(), id);
    assert_eq!(kit.incidents(), before);
    assert_eq!(before[1].alarms[1].aircraft_knows, Some(true));
    let row = kit.store.newest_row().unwrap();
    let next = kit.keep(delivery(2, Completeness::Full)).await.unwrap();
    assert_eq!(
        next,
        Kept::New {
            row: row + 1,
            tells: true
        }
    );
}

async fn two_aircraft_make_one_incident_and_part_when_contradicted(place: Place) {
    let kit = place.kit();
    kit.keep(from("a", 1, 1, 0.0)).await.unwrap();
    kit.keep(from("b", 1, 1, 30.0)).await.unwrap();
    assert_eq!(kit.incidents().len(), 2);
    // The second aircraft knows better now: it is the same fire.
    let row = kit.store.newest_row().unwrap();
    kit.keep(from("b", 1, 2, 2.0)).await.unwrap();
    let one = kit.incidents();
    assert_eq!(
        (one.len(), one[0].id.as_str(), one[0].alarms.len()),
        (1, "a-1", 2)
    );
    assert_eq!(one[0].sightings, 10);
    let news = kit.since(row);
    assert!(
        news.iter().any(
            |news| matches!(news, News::Gone { id, into, .. } if id == "b-1" && into == "a-1")
        )
    );
    assert_eq!(
        kit.incident("b-1").unwrap().id,
        "a-1",
        "the old id still leads there"
    );
    // Sigma of the difference is 1.79 m: the gate to leave lies at 8.2 m.
    kit.keep(from("b", 1, 3, 7.0)).await.unwrap();
    assert_eq!(kit.incidents().len(), 1, "within the wider gate they stay");
    let late = kit.keep(from("b", 1, 2, 40.0)).await.unwrap();
    assert_eq!(late, Kept::Again, "an old revision changes nothing");
    kit.keep(from("b", 1, 4, 20.0)).await.unwrap();
    let two = kit.incidents();
    assert_eq!(
        two.iter().map(|one| one.id.as_str()).collect::<Vec<_>>(),
        ["a-1", "b-1"]
    );
    assert_eq!(place.kit().incidents(), two);
}

async fn operators_are_recorded_once_and_told_to_the_aircraft(place: Place) {
    let kit = place.kit();
    kit.keep(from("a", 1, 1, 0.0)).await.unwrap();
    kit.keep(from("b", 1, 1, 1.0)).await.unwrap();
    let done = kit
        .order("k1", Kind::Acknowledge, "a-1", None)
        .await
        .unwrap();
    assert_eq!((done.action.number, done.again), (1, false));
    let again = kit
        .order("k1", Kind::Acknowledge, "a-1", None)
        .await
        .unwrap();
    assert!(again.again && again.action == done.action);
    let other = kit
        .order("k1", Kind::Dismiss, "a-1", None)
        .await
        .unwrap_err();
    assert!(matches!(other, OrderError::Key { number: 1, .. }));
    let incident = kit.incident("b-1").unwrap();
    assert_eq!(incident.operator.state, OperatorState::Acknowledged);
    assert_eq!(
        incident.operator.at.as_deref(),
        Some("2026-03-01T12:00:00.000000000Z")
    );
    assert_eq!(incident.alarms[0].aircraft_knows, Some(false));

    let told = kit.store.actions_for("b", 0, 10).unwrap();
    assert_eq!(
        (told.len(), told[0].alarm.as_str(), told[0].kind.as_str()),
        (1, "b-1", "acknowledge")
    );
    assert!(kit.store.actions_for("b", 1, 10).unwrap().is_empty());
    kit.writer
        .fetched("a".to_owned(), 1, ServiceTime::from_unix_ns(0))
        .await
        .unwrap();
    // A number that was never given teaches nothing.
    kit.writer
        .fetched("b".to_owned(), 99, ServiceTime::from_unix_ns(0))
        .await
        .unwrap();
    kit.order("k2", Kind::Confirm, "b-1", None).await.unwrap();
    let knows: Vec<_> = kit
        .incident("a-1")
        .unwrap()
        .alarms
        .iter()
        .map(|a| a.aircraft_knows)
        .collect();
    assert_eq!(
        knows,
        [Some(false), Some(false)],
        "of the second action nobody knows yet"
    );
    kit.order("k3", Kind::Undo, "a-1", Some("2")).await.unwrap();
    let state = kit.incident("a-1").unwrap().operator.state;
    assert_eq!(
        state,
        OperatorState::Acknowledged,
        "the first action counts again"
    );
    let twice = kit
        .order("k4", Kind::Undo, "a-1", Some("2"))
        .await
        .unwrap_err();
    assert!(matches!(
        twice,
        OrderError::With {
            kind: Kind::Undo,
            ..
        }
    ));
    let nobody = kit
        .order("k5", Kind::Confirm, "z-9", None)
        .await
        .unwrap_err();
    assert!(matches!(nobody, OrderError::NoIncident { .. }));
    assert_eq!(kit.store.actions_on(&["a-1".to_owned()]).unwrap().len(), 3);
}

async fn operators_merge_and_split_and_take_it_back(place: Place) {
    let kit = place.kit();
    kit.keep(from("a", 1, 1, 0.0)).await.unwrap();
    kit.keep(from("b", 1, 1, 100.0)).await.unwrap();
    let ids = |kit: &Kit| {
        kit.incidents()
            .iter()
            .map(|one| one.id.clone())
            .collect::<Vec<_>>()
    };
    kit.order("k1", Kind::Merge, "b-1", Some("a-1"))
        .await
        .unwrap();
    assert_eq!(ids(&kit), ["a-1"]);
    // Statistics do not overrule the operator, and a restart does not forget him.
    kit.keep(from("b", 1, 2, 120.0)).await.unwrap();
    assert_eq!(ids(&kit), ["a-1"]);
    let kit = place.kit();
    assert_eq!(ids(&kit), ["a-1"]);
    kit.order("k2", Kind::Undo, "a-1", Some("1")).await.unwrap();
    assert_eq!(ids(&kit), ["a-1", "b-1"]);
    kit.keep(from("b", 1, 3, 1.0)).await.unwrap();
    assert_eq!(ids(&kit), ["a-1"], "now they are one by themselves");
    kit.order("k3", Kind::Split, "a-1", Some("b-1"))
        .await
        .unwrap();
    assert_eq!(ids(&kit), ["a-1", "b-1"]);
    kit.keep(from("b", 1, 4, 0.5)).await.unwrap();
    assert_eq!(ids(&kit), ["a-1", "b-1"], "the operator keeps them apart");
    let alone = kit
        .order("k4", Kind::Split, "a-1", Some("a-1"))
        .await
        .unwrap_err();
    assert!(matches!(
        alone,
        OrderError::With {
            kind: Kind::Split,
            ..
        }
    ));
}

async fn area_and_time_find_what_is_there(place: Place) {
    let kit = place.kit();
    kit.keep(from("a", 1, 1, 0.0)).await.unwrap();
    kit.keep(from("b", 1, 1, 500.0)).await.unwrap();
    let found = |bbox: Option<[f64; 4]>, since: Option<&str>, until: Option<&str>| {
        let time = |text: &str| ServiceTime::from_rfc3339(text).unwrap();
        let search = Search {
            bbox,
            since: since.map(time),
            until: until.map(time),
        };
        kit.store.search(&search, 10).unwrap().len()
    };
    assert_eq!(found(None, None, None), 2);
    assert_eq!(
        found(Some([119.111, 31.409, 119.113, 31.410]), None, None),
        1
    );
    assert_eq!(found(Some([119.111, 31.0, 119.12, 31.4]), None, None), 0);
    // Over the antimeridian: everything but 10 degrees around the fires, and only those.
    assert_eq!(found(Some([124.0, 31.0, 114.0, 32.0]), None, None), 0);
    assert_eq!(found(Some([114.0, 31.0, -170.0, 32.0]), None, None), 2);
    assert_eq!(found(None, Some("2026-03-01T12:01:01Z"), None), 2);
    assert_eq!(found(None, Some("2026-03-01T12:01:02Z"), None), 0);
    assert_eq!(found(None, None, Some("2026-03-01T11:59:59Z")), 0);
    // What went into another incident is found once.
    kit.keep(from("b", 1, 2, 1.0)).await.unwrap();
    assert_eq!(found(None, None, None), 1);
    assert_eq!(
        kit.store.incident("b-1").unwrap().unwrap().into.as_deref(),
        Some("a-1")
    );
}

async fn a_batch_is_kept_whole_or_not_at_all(place: Place) {
    let kit = place.kit();
    kit.keep(delivery(1, Completeness::Full)).await.unwrap();
    let new = |row, revision| NewAlarm {
        row,
        delivery: delivery(revision, Completeness::Full),
        tells: true,
    };
    // The second line repeats a row that is taken.
    let batch = Batch {
        alarms: vec![new(2, 2), new(1, 3)],
        ..Batch::default()
    };
    kit.store.commit(&batch).unwrap_err();
    assert_eq!(kit.store.census().unwrap().alarms, 1);
    assert_eq!(kit.store.newest_row().unwrap(), 1);
    let next = kit.keep(delivery(2, Completeness::Full)).await.unwrap();
    assert_eq!(
        next,
        Kept::New {
            row: 2,
            tells: true
        }
    );
}

#[tokio::test]
async fn when_the_disk_fails_nobody_is_told_that_it_was_kept_and_the_next_try_is() {
    let folder = tempfile::tempdir().unwrap();
    let kit = Kit::open(Arc::new(Sqlite::open(folder.path()).unwrap()));
    kit.keep(delivery(1, Completeness::Full)).await.unwrap();
    // Another program holds the database for a moment.
    let blocker = rusqlite::Connection::open(database_in(folder.path())).unwrap();
    blocker
        .execute_batch("ALTER TABLE latest RENAME TO elsewhere")
        .unwrap();
    let refused = kit.keep(delivery(2, Completeness::Full)).await.unwrap_err();
    assert!(matches!(refused, StoreError::Batch { .. }), "{refused}");
    assert_eq!(
        kit.incident("gaochun-1").unwrap().alarms[0].revision,
        1,
        "not shown either"
    );
    blocker
        .execute_batch("ALTER TABLE elsewhere RENAME TO latest")
        .unwrap();
    let kept = kit.keep(delivery(2, Completeness::Full)).await.unwrap();
    assert_eq!(
        kept,
        Kept::New {
            row: 2,
            tells: true
        }
    );
}

#[tokio::test]
async fn a_store_of_the_first_layout_is_brought_up_to_date_and_merged() {
    let folder = tempfile::tempdir().unwrap();
    let old = rusqlite::Connection::open(database_in(folder.path())).unwrap();
    old.execute_batch(sqlite::SCHEMA_1).unwrap();
    old.pragma_update(None, "user_version", 1).unwrap();
    old.execute("INSERT INTO station VALUES ('the-old-one')", [])
        .unwrap();
    for (row, (uav, east_m)) in [("a", 0.0), ("b", 1.0), ("c", 80.0)]
        .into_iter()
        .enumerate()
    {
        let delivery = from(uav, 1, 1, east_m);
        let id = &delivery.alarm.properties.id;
        old.execute(
            "INSERT INTO alarms VALUES (?1, ?2, 1, 0, ?3, '', '', 'http', 1, ?4)",
            rusqlite::params![row as i64 + 1, id, uav, delivery.raw],
        )
        .unwrap();
        old.execute(
            "INSERT INTO incidents VALUES (?1, ?2, 1, 0)",
            rusqlite::params![id, row as i64 + 1],
        )
        .unwrap();
    }
    drop(old);
    let kit = Kit::open(Arc::new(Sqlite::open(folder.path()).unwrap()));
    assert_eq!(kit.store.id(), "the-old-one");
    let ids: Vec<String> = kit.incidents().iter().map(|one| one.id.clone()).collect();
    assert_eq!(ids, ["a-1", "c-1"]);
    assert_eq!(
        kit.store.census().unwrap(),
        Census {
            incidents: 2,
            alarms: 3
        }
    );
    let next = kit.keep(from("a", 1, 2, 0.0)).await.unwrap();
    assert_eq!(
        next,
        Kept::New {
            row: 4,
            tells: true
        }
    );
}

#[test]
fn a_store_of_a_newer_program_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    drop(Sqlite::open(folder.path()).unwrap());
    let database = rusqlite::Connection::open(database_in(folder.path())).unwrap();
    database.pragma_update(None, "user_version", 99).unwrap();
    let refused = Sqlite::open(folder.path());
    assert!(matches!(refused, Err(StoreError::Schema { found: 99, .. })));
}
