//! What was issued as CAP: on disk, so that names and references survive a restart and a message
//! that was once read can be read again.

use super::cap::{self, CapConfig, Issued, Kind, Stood};
use super::view;
use super::xml::Element;
use crate::ground::incident::Incident;
use crate::ground::lock;
use emberfix_frames::ServiceTime;
use rusqlite::{Connection, OptionalExtension, params};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};

const SCHEMA: &str = "
CREATE TABLE IF NOT EXISTS cap (
    row        INTEGER PRIMARY KEY AUTOINCREMENT,
    identifier TEXT NOT NULL UNIQUE,
    incident   TEXT NOT NULL,
    kind       TEXT NOT NULL,
    sent       TEXT NOT NULL,
    title      TEXT NOT NULL,
    stood      TEXT NOT NULL, -- how the incident stood then, as JSON
    reference  TEXT NOT NULL, -- how later messages name this one
    xml        TEXT NOT NULL
) STRICT;
";
/// Messages that the feed lists, newest first.
const LISTED: u32 = 200;

/// Why CAP could not be issued or read.
#[derive(Debug, thiserror::Error)]
pub enum CapError {
    /// SQLite failed.
    #[error("CAP messages: {source}")]
    Sql {
        /// What it said.
        #[from]
        source: rusqlite::Error,
    },
    /// A row does not read as what was once written.
    #[error("CAP messages: how an incident stood can't be read: {source}")]
    Stood {
        /// What the JSON reader said.
        #[from]
        source: serde_json::Error,
    },
}

/// Issues messages and keeps them.
#[derive(Debug)]
pub(super) struct Issuer {
    config: CapConfig,
    kept: Mutex<Kept>,
}

#[derive(Debug)]
struct Kept {
    database: Connection,
    /// Newest message of every incident that was ever told.
    latest: BTreeMap<String, Issued>,
}

impl Issuer {
    pub(super) fn open(config: CapConfig, data_dir: &Path) -> Result<Self, CapError> {
        let database = Connection::open(data_dir.join("cap.sqlite"))?;
        database.pragma_update(None, "journal_mode", "WAL")?;
        database.pragma_update(None, "synchronous", "FULL")?;
        database.execute_batch(SCHEMA)?;
        let latest = latest(&database)?;
        Ok(Self {
            config,
            kept: Mutex::new(Kept { database, latest }),
        })
    }

    /// Issues what is due; the number of messages.
    pub(super) fn issue(
        &self,
        incidents: &[Arc<Incident>],
        now: ServiceTime,
    ) -> Result<usize, CapError> {
        let mut kept = lock(&self.kept);
        let due: Vec<_> = incidents
            .iter()
            .filter_map(|incident| {
                Some((
                    incident,
                    cap::due(incident, kept.latest.get(&incident.id), now)?,
                ))
            })
            .collect();
        for (incident, kind) in &due {
            kept.issue(incident, *kind, &self.config, now)?;
        }
        Ok(due.len())
    }

    /// One message as it was issued.
    pub(super) fn message(&self, identifier: &str) -> Result<Option<String>, CapError> {
        let query = "SELECT xml FROM cap WHERE identifier = ?1";
        let kept = lock(&self.kept);
        Ok(kept
            .database
            .query_row(query, [identifier], |row| row.get(0))
            .optional()?)
    }

    /// Atom feed of the newest messages; `base` is where this station is reached.
    pub(super) fn feed(&self, base: &str, now: ServiceTime) -> Result<String, CapError> {
        let kept = lock(&self.kept);
        let mut statement = kept
            .database
            .prepare_cached("SELECT identifier, title, sent FROM cap ORDER BY row DESC LIMIT ?1")?;
        let entries: Vec<(String, String, String)> = statement
            .query_map([LISTED], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)))?
            .collect::<Result<_, _>>()?;
        let updated = entries
            .first()
            .map_or_else(|| now.rfc3339(), |(_, _, sent)| sent.clone());
        let feed = Element::new("feed")
            .with("xmlns", "http://www.w3.org/2005/Atom")
            .field("id", format_args!("{base}/cap.atom"))
            .field("title", "Fires seen from the air")
            .field("updated", updated)
            .child(Element::new("author").field("name", &self.config.sender))
            .child(
                Element::new("link")
                    .with("rel", "self")
                    .with("href", format_args!("{base}/cap.atom")),
            )
            .children(entries.into_iter().map(|entry| feed_entry(base, entry)));
        Ok(feed.document())
    }
}

impl Kept {
    fn issue(
        &mut self,
        incident: &Incident,
        kind: Kind,
        config: &CapConfig,
        now: ServiceTime,
    ) -> Result<(), CapError> {
        let mut references = self
            .latest
            .get(&incident.id)
            .map_or_else(Vec::new, |issued| issued.references.clone());
        // A new Alert after a Cancel begins a new chain.
        let earlier = if kind == Kind::Alert {
            &[]
        } else {
            &references[..]
        };
        let identifier = self.name(incident)?;
        let xml = cap::message(kind, incident, &identifier, earlier, config, now);
        let reference = cap::reference(&config.sender, &identifier, now);
        let stood = Stood::of(incident);
        self.database.execute(
            "INSERT INTO cap (identifier, incident, kind, sent, title, stood, reference, xml)
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
            params![
                identifier,
                incident.id,
                kind.word(),
                now.rfc3339(),
                format!("{}: {}", kind.word(), view::callsign(incident)),
                serde_json::to_string(&stood)?,
                reference,
                xml
            ],
        )?;
        if kind == Kind::Alert {
            references.clear();
        }
        references.push(reference);
        self.latest.insert(
            incident.id.clone(),
            Issued {
                kind,
                sent: now,
                stood,
                references,
            },
        );
        Ok(())
    }

    /// `<incident>.<number of the message>`: never given twice.
    fn name(&self, incident: &Incident) -> Result<String, CapError> {
        let query = "SELECT count(*) FROM cap WHERE incident = ?1";
        let before: i64 = self
            .database
            .query_row(query, [&incident.id], |row| row.get(0))?;
        Ok(format!("{}.{}", cap::token(&incident.id), before + 1))
    }
}

fn latest(database: &Connection) -> Result<BTreeMap<String, Issued>, CapError> {
    let mut latest: BTreeMap<String, Issued> = BTreeMap::new();
    let mut statement =
        database.prepare("SELECT incident, kind, sent, stood, reference FROM cap ORDER BY row")?;
    let mut rows = statement.query([])?;
    while let Some(row) = rows.next()? {
        let incident: String = row.get(0)?;
        let (kind, sent): (String, String) = (row.get(1)?, row.get(2)?);
        let stood: String = row.get(3)?;
        let kind = Kind::named(&kind).unwrap_or(Kind::Update);
        let mut references = latest
            .remove(&incident)
            .map_or_else(Vec::new, |issued| issued.references);
        if kind == Kind::Alert {
            references.clear();
        }
        references.push(row.get(4)?);
        let issued = Issued {
            kind,
            sent: ServiceTime::from_rfc3339(&sent).unwrap_or(ServiceTime::from_unix_ns(0)),
            stood: serde_json::from_str(&stood)?,
            references,
        };
        latest.insert(incident, issued);
    }
    Ok(latest)
}

fn feed_entry(base: &str, (identifier, title, sent): (String, String, String)) -> Element {
    let href = format!("{base}/cap/{identifier}.xml");
    let link = Element::new("link")
        .with("type", "application/cap+xml")
        .with("href", &href);
    Element::new("entry")
        .field("id", href)
        .field("title", title)
        .field("updated", sent)
        .child(link)
        .field("summary", identifier)
}
