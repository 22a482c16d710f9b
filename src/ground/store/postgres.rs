//! The store for many stations and long histories: PostgreSQL with PostGIS.
//!
//! One statement per table and batch, one commit per batch, synced by the server: one that does not
//! sync (`fsync = off`) is refused. Everything lies in a schema of its own, `emberfix`. Places are
//! `geometry(Point, 4326)` under a spatial index, for the station's queries and anybody else's.
//! A server that went away is connected to again with the next batch or question.
//! Beyond this machine the line is TLS (`store::tls`); the configuration sees to that.

use super::super::action::{Action, Kind};
use super::super::{bus, lock};
use super::tls::Tls;
use super::{
    Batch, BusCursor, BusRow, Census, Completeness, HistoryRow, Latest, Loaded, NewAction,
    NewAlarm, Rank, Row, SCHEMA_VERSION, Search, Standing, Store, StoreError, ToldAction, list,
    on_one_line, unlist,
};
use ::postgres::config::SslMode;
use ::postgres::{Client, Config, NoTls, Transaction};
use emberfix_frames::ServiceTime;
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

const SCHEMA: &str = "
CREATE EXTENSION IF NOT EXISTS postgis;
CREATE SCHEMA IF NOT EXISTS emberfix;
CREATE TABLE IF NOT EXISTS emberfix.station (
    store_id text NOT NULL, version bigint NOT NULL, single boolean PRIMARY KEY DEFAULT true CHECK (single)
);
CREATE TABLE IF NOT EXISTS emberfix.alarms (
    \"row\" bigint PRIMARY KEY, id text NOT NULL, revision bigint NOT NULL, summary boolean NOT NULL,
    uav text NOT NULL, captured_at text NOT NULL, received_at text NOT NULL, link text NOT NULL,
    tells boolean NOT NULL, feature text NOT NULL, UNIQUE (id, revision, summary)
);
CREATE TABLE IF NOT EXISTS emberfix.latest (
    id text PRIMARY KEY, \"row\" bigint NOT NULL, revision bigint NOT NULL, summary boolean NOT NULL,
    first_row bigint NOT NULL, revisions bigint NOT NULL, incident text
);
CREATE INDEX IF NOT EXISTS latest_incident ON emberfix.latest (incident);
CREATE INDEX IF NOT EXISTS latest_row ON emberfix.latest (\"row\");
CREATE TABLE IF NOT EXISTS emberfix.incidents (
    id text PRIMARY KEY, \"row\" bigint NOT NULL, into_id text,
    place geometry(Point, 4326) NOT NULL, first_seen_ns bigint NOT NULL, captured_ns bigint NOT NULL,
    feature text NOT NULL
);
CREATE INDEX IF NOT EXISTS incidents_row ON emberfix.incidents (\"row\");
CREATE INDEX IF NOT EXISTS incidents_place ON emberfix.incidents USING gist (place);
CREATE INDEX IF NOT EXISTS incidents_time ON emberfix.incidents (captured_ns);
CREATE TABLE IF NOT EXISTS emberfix.actions (
    number bigint PRIMARY KEY, \"row\" bigint NOT NULL, key text NOT NULL UNIQUE, kind text NOT NULL,
    incident text NOT NULL, alarms text NOT NULL, others text NOT NULL, \"of\" bigint,
    \"by\" text NOT NULL, \"at\" text NOT NULL, note text, undone boolean NOT NULL
);
CREATE TABLE IF NOT EXISTS emberfix.told (
    uav text NOT NULL, number bigint NOT NULL, alarm text NOT NULL, PRIMARY KEY (uav, number, alarm)
);
CREATE INDEX IF NOT EXISTS told_alarm ON emberfix.told (alarm);
CREATE TABLE IF NOT EXISTS emberfix.fetched (
    uav text PRIMARY KEY, number bigint NOT NULL, \"at\" text NOT NULL
);
CREATE TABLE IF NOT EXISTS emberfix.bus (
    single boolean PRIMARY KEY DEFAULT true CHECK (single),
    \"row\" bigint NOT NULL, sequence bigint NOT NULL, stream text NOT NULL
);
ALTER TABLE emberfix.bus ADD COLUMN IF NOT EXISTS message text NOT NULL DEFAULT '';
";

const LATEST: &str = "SELECT latest.id, latest.\"row\", latest.revision, latest.summary, first_row,
    revisions, incident, feature FROM latest JOIN alarms USING (\"row\")";
const ACTION: &str = "SELECT number, \"row\", key, kind, incident, alarms, others, \"of\", \"by\",
    \"at\", note, undone FROM actions";

/// Connections to one database: one writes, one reads beside it.
#[derive(Debug)]
pub(in crate::ground) struct Postgres {
    writer: Mutex<Line>,
    reader: Mutex<Line>,
    id: String,
}

/// A connection that is made anew when the server has gone.
struct Line {
    config: Config,
    tls: Option<Tls>,
    client: Option<Client>,
}

impl std::fmt::Debug for Line {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Line").finish_non_exhaustive()
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        // Closing blocks, and the last owner may be a task that must not.
        let client = self.client.take();
        std::thread::spawn(move || drop(client));
    }
}

impl Line {
    fn client(&mut self) -> Result<&mut Client, StoreError> {
        if self.client.as_ref().is_none_or(Client::is_closed) {
            let mut client = match self.tls.clone() {
                Some(tls) => self.config.connect(tls)?,
                None => self.config.connect(NoTls)?,
            };
            client
                .batch_execute("SET search_path = emberfix, public; SET synchronous_commit = on")?;
            self.client = Some(client);
        }
        self.client.as_mut().ok_or(StoreError::Stopped)
    }
}

impl Postgres {
    /// Connects, and makes the schema where there is none. With an authority, over TLS alone. Blocks.
    ///
    /// # Errors
    /// [`StoreError`] in the server's words.
    pub fn open(url: &str, authority: Option<&Path>) -> Result<Self, StoreError> {
        let mut config: Config = url.parse()?;
        let tls = authority.map(Tls::trusting).transpose()?;
        if tls.is_some() {
            config.ssl_mode(SslMode::Require);
        }
        config
            .application_name("emberfix ground")
            .connect_timeout(Duration::from_secs(5));
        let line = || Line {
            config: config.clone(),
            tls: tls.clone(),
            client: None,
        };
        let mut writer = line();
        let id = prepare(writer.client()?)?;
        Ok(Self {
            writer: Mutex::new(writer),
            reader: Mutex::new(line()),
            id,
        })
    }

    fn rows<T>(
        &self,
        query: &str,
        parameters: &[&(dyn ::postgres::types::ToSql + Sync)],
        read: impl Fn(&::postgres::Row) -> Result<T, ::postgres::Error>,
    ) -> Result<Vec<T>, StoreError> {
        let mut reader = lock(&self.reader);
        let rows = reader.client()?.query(query, parameters)?;
        Ok(rows.iter().map(read).collect::<Result<_, _>>()?)
    }

    fn number(&self, query: &str) -> Result<i64, StoreError> {
        let found = self.rows(query, &[], |row| row.try_get(0))?;
        Ok(found.into_iter().next().unwrap_or_default())
    }
}

#[cfg(test)]
impl Postgres {
    /// Whether the server says that this connection is encrypted.
    pub(super) fn is_over_tls(&self) -> Result<bool, StoreError> {
        let query = "SELECT ssl FROM pg_stat_ssl WHERE pid = pg_backend_pid()";
        let found: Vec<bool> = self.rows(query, &[], |row| row.try_get(0))?;
        Ok(found == [true])
    }
}

fn prepare(client: &mut Client) -> Result<String, StoreError> {
    let synced: String = client.query_one("SHOW fsync", &[])?.get(0);
    if synced != "on" {
        return Err(StoreError::Unsynced {
            what: "PostgreSQL has fsync = off",
        });
    }
    let mut transaction = client.transaction()?;
    // Two stations may start at once.
    transaction.batch_execute("SELECT pg_advisory_xact_lock(20260301)")?;
    transaction.batch_execute(SCHEMA)?;
    transaction.execute(
        "INSERT INTO emberfix.station VALUES ($1, $2) ON CONFLICT DO NOTHING",
        &[&uuid::Uuid::new_v4().to_string(), &SCHEMA_VERSION],
    )?;
    let station = transaction.query_one("SELECT store_id, version FROM emberfix.station", &[])?;
    let (id, found): (String, i64) = (station.get(0), station.get(1));
    if found > SCHEMA_VERSION {
        return Err(StoreError::Schema {
            place: "emberfix of PostgreSQL".to_owned(),
            found,
        });
    }
    transaction.commit()?;
    Ok(id)
}

fn int(limit: u32) -> i64 {
    i64::from(limit)
}

impl Store for Postgres {
    fn id(&self) -> &str {
        &self.id
    }

    fn load(&self, limit: u32) -> Result<Loaded, StoreError> {
        let newest = format!(
            "{LATEST} WHERE incident IS NULL OR incident IN (SELECT id FROM incidents
             WHERE into_id IS NULL ORDER BY \"row\" DESC LIMIT $1)"
        );
        let rows = "SELECT id, \"row\" FROM incidents WHERE into_id IS NULL
                    ORDER BY \"row\" DESC LIMIT $1";
        let gone = "SELECT id, \"row\", into_id FROM incidents WHERE into_id IS NOT NULL
                    ORDER BY \"row\" DESC LIMIT $1";
        let limit = int(limit);
        Ok(Loaded {
            latest: self.rows(&newest, &[&limit], read_latest)?,
            more: self.number("SELECT count(*) FROM incidents WHERE into_id IS NULL")? > limit,
            rows: self
                .rows(rows, &[&limit], |row| {
                    Ok((row.try_get(0)?, row.try_get(1)?))
                })?
                .into_iter()
                .collect(),
            gone: self.rows(gone, &[&limit], |row| {
                Ok((row.try_get(0)?, row.try_get(1)?, row.try_get(2)?))
            })?,
            actions: self.actions(&format!("{ACTION} ORDER BY number"), &[])?,
            fetched: self
                .rows("SELECT uav, number FROM fetched", &[], |row| {
                    Ok((row.try_get(0)?, row.try_get(1)?))
                })?
                .into_iter()
                .collect(),
        })
    }

    fn commit(&self, batch: &Batch) -> Result<(), StoreError> {
        let mut writer = lock(&self.writer);
        let mut transaction = writer.client()?.transaction()?;
        insert_alarms(&mut transaction, &batch.alarms)?;
        put_latest(&mut transaction, &batch.latest.values().collect::<Vec<_>>())?;
        put_incidents(
            &mut transaction,
            &batch.incidents.values().collect::<Vec<_>>(),
        )?;
        for action in &batch.actions {
            insert_action(&mut transaction, action)?;
        }
        put_rest(&mut transaction, batch)?;
        Ok(transaction.commit()?)
    }

    fn revision(&self, id: &str, revision: u32) -> Result<Vec<(String, bool)>, StoreError> {
        let query = "SELECT feature, NOT summary FROM alarms WHERE id = $1 AND revision = $2
                     ORDER BY summary";
        self.rows(query, &[&id, &int(revision)], |row| {
            Ok((row.try_get(0)?, row.try_get(1)?))
        })
    }

    fn recall(&self, id: &str) -> Result<Vec<Latest>, StoreError> {
        let query = format!(
            "{LATEST} WHERE latest.id = $1 OR incident = (SELECT incident FROM latest WHERE id = $1)"
        );
        self.rows(&query, &[&id], read_latest)
    }

    fn latest_after(&self, after: i64, limit: u32) -> Result<Vec<Row>, StoreError> {
        let query = "SELECT \"row\", feature FROM latest JOIN alarms USING (\"row\")
                     WHERE \"row\" > $1 ORDER BY \"row\" LIMIT $2";
        self.rows(query, &[&after, &int(limit)], read_row)
    }

    fn told_after(&self, after: i64, limit: u32) -> Result<Vec<Row>, StoreError> {
        let query = "SELECT \"row\", feature FROM alarms WHERE \"row\" > $1 AND tells
                     ORDER BY \"row\" LIMIT $2";
        self.rows(query, &[&after, &int(limit)], read_row)
    }

    fn history(&self, alarms: &[String], limit: u32) -> Result<Vec<HistoryRow>, StoreError> {
        let query = "SELECT \"row\", received_at, link, feature FROM alarms WHERE id = ANY($1)
                     ORDER BY \"row\" DESC LIMIT $2";
        self.rows(query, &[&alarms, &int(limit)], |row| {
            Ok(HistoryRow {
                row: row.try_get(0)?,
                received_at: row.try_get(1)?,
                link: row.try_get(2)?,
                feature: on_one_line(row.try_get(3)?),
            })
        })
    }

    fn incident(&self, id: &str) -> Result<Option<Standing>, StoreError> {
        let query = "SELECT id, \"row\", into_id, ST_Y(place), ST_X(place), first_seen_ns,
                     captured_ns, feature FROM incidents WHERE id = $1";
        let found = self.rows(query, &[&id], |row| {
            Ok(Standing {
                id: row.try_get(0)?,
                row: row.try_get(1)?,
                into: row.try_get(2)?,
                latitude_deg: row.try_get(3)?,
                longitude_deg: row.try_get(4)?,
                first_seen_at: ServiceTime::from_unix_ns(row.try_get(5)?),
                captured_at: ServiceTime::from_unix_ns(row.try_get(6)?),
                feature: row.try_get(7)?,
            })
        })?;
        Ok(found.into_iter().next())
    }

    fn search(&self, search: &Search, limit: u32) -> Result<Vec<String>, StoreError> {
        let [west, south, east, north] = search.bbox.unwrap_or([-180.0, -90.0, 180.0, 90.0]);
        // Over the antimeridian: two boxes.
        let (left, right) = if west <= east {
            (east, west)
        } else {
            (180.0, -180.0)
        };
        let query = "SELECT feature FROM incidents WHERE into_id IS NULL
            AND (place && ST_MakeEnvelope($1, $2, $3, $4, 4326)
              OR place && ST_MakeEnvelope($5, $2, $6, $4, 4326))
            AND captured_ns >= $7 AND first_seen_ns <= $8 ORDER BY \"row\" DESC LIMIT $9";
        let since = search.since.map_or(i64::MIN, ServiceTime::unix_ns);
        let until = search.until.map_or(i64::MAX, ServiceTime::unix_ns);
        self.rows(
            query,
            &[
                &west,
                &south,
                &left,
                &north,
                &right,
                &east,
                &since,
                &until,
                &int(limit),
            ],
            |row| row.try_get(0),
        )
    }

    fn actions_for(
        &self,
        uav: &str,
        after: i64,
        limit: u32,
    ) -> Result<Vec<ToldAction>, StoreError> {
        let query =
            "SELECT number, alarm, kind, \"at\", \"by\" FROM told JOIN actions USING (number)
                     WHERE uav = $1 AND number > $2 ORDER BY number, alarm LIMIT $3";
        self.rows(query, &[&uav, &after, &int(limit)], |row| {
            Ok(ToldAction {
                number: row.try_get(0)?,
                alarm: row.try_get(1)?,
                kind: row.try_get(2)?,
                at: row.try_get(3)?,
                by: row.try_get(4)?,
            })
        })
    }

    fn action_by_key(&self, key: &str) -> Result<Option<Action>, StoreError> {
        Ok(self
            .actions(&format!("{ACTION} WHERE key = $1"), &[&key])?
            .pop())
    }

    fn actions_on(&self, alarms: &[String]) -> Result<Vec<Action>, StoreError> {
        let query = format!(
            "{ACTION} WHERE number IN (SELECT number FROM told WHERE alarm = ANY($1)) ORDER BY number"
        );
        self.actions(&query, &[&alarms])
    }

    fn newest_row(&self) -> Result<i64, StoreError> {
        self.number(
            "SELECT greatest((SELECT coalesce(max(\"row\"), 0) FROM alarms),
                             (SELECT coalesce(max(\"row\"), 0) FROM actions),
                             (SELECT coalesce(max(\"row\"), 0) FROM incidents))",
        )
    }

    fn newest_action(&self) -> Result<i64, StoreError> {
        self.number("SELECT coalesce(max(number), 0) FROM actions")
    }

    fn census(&self) -> Result<Census, StoreError> {
        Ok(Census {
            incidents: self.number("SELECT count(*) FROM incidents WHERE into_id IS NULL")?,
            alarms: self.number("SELECT count(*) FROM alarms")?,
        })
    }

    fn bus_after(&self, after: i64, limit: u32) -> Result<Vec<BusRow>, StoreError> {
        let query = "SELECT \"row\", id, revision, summary, uav, feature FROM alarms
                     WHERE \"row\" > $1 AND link <> $2 ORDER BY \"row\" LIMIT $3";
        self.rows(query, &[&after, &bus::LINK_NAME, &int(limit)], |row| {
            Ok(BusRow {
                row: row.try_get(0)?,
                id: row.try_get(1)?,
                revision: u32::try_from(row.try_get::<_, i64>(2)?).unwrap_or(u32::MAX),
                completeness: Completeness::of(row.try_get(3)?),
                uav: row.try_get(4)?,
                feature: row.try_get(5)?,
            })
        })
    }

    fn bus_cursor(&self) -> Result<BusCursor, StoreError> {
        let query = "SELECT \"row\", sequence, stream, message FROM bus";
        let found = self.rows(query, &[], |row| {
            Ok(BusCursor {
                row: row.try_get(0)?,
                sequence: row.try_get::<_, i64>(1)?.unsigned_abs(),
                stream: row.try_get(2)?,
                message: row.try_get(3)?,
            })
        })?;
        Ok(found.into_iter().next().unwrap_or_default())
    }
}

impl Postgres {
    fn actions(
        &self,
        query: &str,
        parameters: &[&(dyn ::postgres::types::ToSql + Sync)],
    ) -> Result<Vec<Action>, StoreError> {
        let mut reader = lock(&self.reader);
        let rows = reader.client()?.query(query, parameters)?;
        rows.iter().map(read_action).collect()
    }
}

fn column<'a, R, T>(records: &'a [R], value: impl Fn(&'a R) -> T) -> Vec<T> {
    records.iter().map(value).collect()
}

fn insert_alarms(to: &mut Transaction<'_>, new: &[NewAlarm]) -> Result<(), StoreError> {
    if new.is_empty() {
        return Ok(());
    }
    let of = |new: &'_ NewAlarm| new.delivery.alarm.properties.clone();
    to.execute(
        "INSERT INTO alarms SELECT * FROM unnest($1::bigint[], $2::text[], $3::bigint[],
         $4::boolean[], $5::text[], $6::text[], $7::text[], $8::text[], $9::boolean[], $10::text[])",
        &[
            &column(new, |new| new.row),
            &column(new, |new| of(new).id),
            &column(new, |new| int(new.delivery.rank().revision)),
            &column(new, |new| !new.delivery.rank().full),
            &column(new, |new| of(new).uav),
            &column(new, |new| of(new).captured_at.rfc3339()),
            &column(new, |new| new.delivery.received_at.rfc3339()),
            &column(new, |new| new.delivery.link),
            &column(new, |new| new.tells),
            &column(new, |new| new.delivery.raw.as_str()),
        ],
    )?;
    Ok(())
}

fn put_latest(to: &mut Transaction<'_>, latest: &[&Latest]) -> Result<(), StoreError> {
    if latest.is_empty() {
        return Ok(());
    }
    to.execute(
        "INSERT INTO latest SELECT * FROM unnest($1::text[], $2::bigint[], $3::bigint[],
         $4::boolean[], $5::bigint[], $6::bigint[], $7::text[])
         ON CONFLICT (id) DO UPDATE SET \"row\" = excluded.\"row\", revision = excluded.revision,
         summary = excluded.summary, first_row = excluded.first_row,
         revisions = excluded.revisions, incident = excluded.incident",
        &[
            &column(latest, |latest| latest.id.as_str()),
            &column(latest, |latest| latest.row),
            &column(latest, |latest| int(latest.rank.revision)),
            &column(latest, |latest| !latest.rank.full),
            &column(latest, |latest| latest.first_row),
            &column(latest, |latest| {
                i64::try_from(latest.revisions).unwrap_or(i64::MAX)
            }),
            &column(latest, |latest| latest.incident.as_deref()),
        ],
    )?;
    Ok(())
}

fn put_incidents(to: &mut Transaction<'_>, standing: &[&Standing]) -> Result<(), StoreError> {
    if standing.is_empty() {
        return Ok(());
    }
    to.execute(
        "INSERT INTO incidents
         SELECT id, at_row, into_id, ST_SetSRID(ST_MakePoint(longitude, latitude), 4326),
                first_seen, captured, feature
         FROM unnest($1::text[], $2::bigint[], $3::text[], $4::float8[], $5::float8[],
                     $6::bigint[], $7::bigint[], $8::text[])
              AS come (id, at_row, into_id, longitude, latitude, first_seen, captured, feature)
         ON CONFLICT (id) DO UPDATE SET \"row\" = excluded.\"row\", into_id = excluded.into_id,
         place = excluded.place, first_seen_ns = excluded.first_seen_ns,
         captured_ns = excluded.captured_ns, feature = excluded.feature",
        &[
            &column(standing, |standing| standing.id.as_str()),
            &column(standing, |standing| standing.row),
            &column(standing, |standing| standing.into.as_deref()),
            &column(standing, |standing| standing.longitude_deg),
            &column(standing, |standing| standing.latitude_deg),
            &column(standing, |standing| standing.first_seen_at.unix_ns()),
            &column(standing, |standing| standing.captured_at.unix_ns()),
            &column(standing, |standing| standing.feature.as_str()),
        ],
    )?;
    Ok(())
}

fn insert_action(to: &mut Transaction<'_>, new: &NewAction) -> Result<(), StoreError> {
    let action = &new.action;
    to.execute(
        "INSERT INTO actions VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12)",
        &[
            &action.number,
            &action.row,
            &action.key,
            &action.kind.name(),
            &action.incident,
            &list(&action.alarms),
            &list(&action.others),
            &action.of,
            &action.by,
            &action.at.rfc3339(),
            &action.note,
            &action.undone,
        ],
    )?;
    for (alarm, uav) in &new.tell {
        let values: [&(dyn ::postgres::types::ToSql + Sync); 3] = [uav, &action.number, alarm];
        to.execute("INSERT INTO told VALUES ($1, $2, $3)", &values)?;
    }
    Ok(())
}

fn put_rest(to: &mut Transaction<'_>, batch: &Batch) -> Result<(), StoreError> {
    if !batch.undone.is_empty() {
        let query = "UPDATE actions SET undone = true WHERE number = ANY($1)";
        to.execute(query, &[&batch.undone])?;
    }
    for (uav, (number, at)) in &batch.fetched {
        to.execute(
            "INSERT INTO fetched VALUES ($1, $2, $3) ON CONFLICT (uav) DO UPDATE SET
             number = excluded.number, \"at\" = excluded.\"at\"",
            &[uav, number, &at.rfc3339()],
        )?;
    }
    if let Some(bus) = &batch.bus {
        let sequence = i64::try_from(bus.sequence).unwrap_or(i64::MAX);
        to.execute(
            "INSERT INTO bus (\"row\", sequence, stream, message) VALUES ($1, $2, $3, $4)
             ON CONFLICT (single) DO UPDATE SET \"row\" = excluded.\"row\", sequence = excluded.sequence,
             stream = excluded.stream, message = excluded.message",
            &[&bus.row, &sequence, &bus.stream, &bus.message],
        )?;
    }
    Ok(())
}

fn read_row(row: &::postgres::Row) -> Result<Row, ::postgres::Error> {
    Ok(Row {
        row: row.try_get(0)?,
        feature: on_one_line(row.try_get(1)?),
    })
}

fn read_latest(row: &::postgres::Row) -> Result<Latest, ::postgres::Error> {
    Ok(Latest {
        id: row.try_get(0)?,
        row: row.try_get(1)?,
        rank: Rank {
            revision: u32::try_from(row.try_get::<_, i64>(2)?).unwrap_or(u32::MAX),
            full: !row.try_get::<_, bool>(3)?,
        },
        first_row: row.try_get(4)?,
        revisions: row.try_get::<_, i64>(5)?.unsigned_abs(),
        incident: row.try_get(6)?,
        feature: row.try_get(7)?,
    })
}

fn read_action(row: &::postgres::Row) -> Result<Action, StoreError> {
    let number: i64 = row.try_get(0)?;
    let damaged = |reason: &str| StoreError::Damaged {
        what: "action",
        id: number.to_string(),
        reason: reason.to_owned(),
    };
    let (kind, at): (String, String) = (row.try_get(3)?, row.try_get(9)?);
    Ok(Action {
        number,
        row: row.try_get(1)?,
        key: row.try_get(2)?,
        kind: Kind::named(&kind).ok_or_else(|| damaged("unknown kind"))?,
        incident: row.try_get(4)?,
        alarms: unlist(&row.try_get::<_, String>(5)?),
        others: unlist(&row.try_get::<_, String>(6)?),
        of: row.try_get(7)?,
        by: row.try_get(8)?,
        at: ServiceTime::from_rfc3339(&at).ok_or_else(|| damaged("no time"))?,
        note: row.try_get(10)?,
        undone: row.try_get(11)?,
    })
}
