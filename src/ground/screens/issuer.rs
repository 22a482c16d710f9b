//! What was issued as CAP: on disk, so that names and references survive a restart and a message
//! that was once read can be read again.

use super::cap::{self, CapConfig, Heading, Issued, Kind, Stood};
use super::view;
use super::xml::Element;
use crate::ground::incident::Incident;
use crate::ground::lock;
use emberfix_frames::ServiceTime;
use rusqlite::{Connection, OptionalExtension, params};
use std::collections::{BTreeMap, BTreeSet};
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
CREATE INDEX IF NOT EXISTS cap_incident ON cap (incident);
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

    /// Issues what is due. `heir` is the incident that another went into, if it did.
    pub(super) fn issue(
        &self,
        incidents: &[Arc<Incident>],
        heir: impl Fn(&str) -> Option<Arc<Incident>>,
        now: ServiceTime,
    ) -> Result<(), CapError> {
        let mut kept = lock(&self.kept);
        for incident in incidents {
            if let Some(kind) = cap::due(incident, kept.latest.get(&incident.id), now) {
                kept.tell(incident, kind, &self.config, now)?;
            }
        }
        let gone = kept.gone(incidents);
        for (id, heir) in gone
            .into_iter()
            .filter_map(|id| heir(&id).map(|heir| (id, heir)))
        {
            kept.cancel_merged(&id, &heir, &self.config, now)?;
        }
        Ok(())
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

/// A message that is about to be kept.
struct Message<'a> {
    id: &'a str,
    kind: Kind,
    title: String,
    stood: Stood,
    sent: ServiceTime,
}

impl Kept {
    /// Incidents that were told, not taken back, and do not stand any more.
    fn gone(&self, incidents: &[Arc<Incident>]) -> Vec<String> {
        let standing: BTreeSet<&str> = incidents.iter().map(|i| i.id.as_str()).collect();
        let told = self
            .latest
            .iter()
            .filter(|(id, issued)| issued.kind != Kind::Cancel && !standing.contains(id.as_str()));
        told.map(|(id, _)| id.clone()).collect()
    }

    fn tell(
        &mut self,
        incident: &Incident,
        kind: Kind,
        config: &CapConfig,
        now: ServiceTime,
    ) -> Result<(), CapError> {
        let message = Message {
            id: &incident.id,
            kind,
            title: format!("{}: {}", kind.word(), view::callsign(incident)),
            stood: Stood::of(incident),
            sent: now,
        };
        self.keep(message, config, |heading| {
            cap::message(kind, incident, heading, config)
        })
    }

    fn cancel_merged(
        &mut self,
        id: &str,
        heir: &Incident,
        config: &CapConfig,
        now: ServiceTime,
    ) -> Result<(), CapError> {
        let message = Message {
            id,
            kind: Kind::Cancel,
            title: format!("Cancel: {id} is {}", view::callsign(heir)),
            stood: Stood::of(heir),
            sent: now,
        };
        self.keep(message, config, |heading| {
            cap::merged(id, heir, heading, config)
        })
    }

    /// Names a message, writes it, and remembers it; on disk before anybody can read it.
    fn keep(
        &mut self,
        message: Message<'_>,
        config: &CapConfig,
        write: impl FnOnce(Heading<'_>) -> String,
    ) -> Result<(), CapError> {
        // A new Alert after a Cancel begins a new chain.
        let earlier = match (message.kind, self.latest.get(message.id)) {
            (Kind::Alert, _) | (_, None) => Vec::new(),
            (_, Some(issued)) => issued.references.clone(),
        };
        let identifier = self.name(message.id)?;
        let heading = Heading {
            identifier: &identifier,
            earlier: &earlier,
            sent: message.sent,
        };
        let reference = cap::reference(&config.sender, &identifier, message.sent);
        self.database.execute(
            "INSERT INTO cap (identifier, incident, kind, sent, title, stood, reference, xml)
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
            params![
                identifier,
                message.id,
                message.kind.word(),
                message.sent.rfc3339(),
                message.title,
                serde_json::to_string(&message.stood)?,
                reference,
                write(heading)
            ],
        )?;
        let mut references = earlier;
        references.push(reference);
        let issued = Issued {
            kind: message.kind,
            sent: message.sent,
            stood: message.stood,
            references,
        };
        self.latest.insert(message.id.to_owned(), issued);
        Ok(())
    }

    /// `<incident>.<number of the message>`: never given twice.
    fn name(&self, id: &str) -> Result<String, CapError> {
        let query = "SELECT count(*) FROM cap WHERE incident = ?1";
        let before: i64 = self.database.query_row(query, [id], |row| row.get(0))?;
        Ok(format!("{}.{}", cap::token(id), before + 1))
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
