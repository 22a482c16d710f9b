//! What stands now, for everyone who shows it: read often, written once per batch.

use super::incident::{Incident, News};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// All incidents by id and by the row at which they last changed.
#[derive(Debug, Default)]
pub(super) struct Board {
    standing: BTreeMap<String, Arc<Incident>>,
    /// Incidents that went into others: id to row and heir.
    gone: BTreeMap<String, (i64, String)>,
    by_row: BTreeSet<(i64, String)>,
}

impl Board {
    /// Applies a change. Not older than what it knows: the writer is one thread.
    pub fn apply(&mut self, news: News) {
        let (row, id) = (news.row(), news.id().to_owned());
        self.forget(&id);
        self.by_row.insert((row, id.clone()));
        match news {
            News::Changed(incident) => drop(self.standing.insert(id, incident)),
            News::Gone { into, .. } => drop(self.gone.insert(id, (row, into))),
        }
    }

    /// Takes an incident off the board altogether (it is on disk).
    pub fn forget(&mut self, id: &str) {
        let before = self.standing.remove(id).map(|incident| incident.row);
        let before = before.or_else(|| self.gone.remove(id).map(|(row, _)| row));
        if let Some(row) = before {
            self.by_row.remove(&(row, id.to_owned()));
        }
    }

    /// An incident; of one that went into another, that other.
    pub fn get(&self, id: &str) -> Option<&Arc<Incident>> {
        let mut id = id;
        // Bound: heirs of heirs, each once.
        for _ in 0..=self.gone.len() {
            if let Some(standing) = self.standing.get(id) {
                return Some(standing);
            }
            id = &self.gone.get(id)?.1;
        }
        None
    }

    /// All that stand, by id.
    pub fn all(&self) -> impl Iterator<Item = &Arc<Incident>> {
        self.standing.values()
    }

    /// At most `limit` incidents that changed after a row, each as it is now, oldest change first.
    pub fn since(&self, after: i64, limit: usize) -> Vec<News> {
        let from = (after.saturating_add(1), String::new());
        let changed: Vec<_> = self.by_row.range(from..).take(limit).collect();
        let last = changed.last().map_or(after, |(row, _)| *row);
        // A row that changed several incidents is told whole, or its rest would be passed over.
        let rest = self.by_row.range((last, String::new())..);
        let rest = rest.take_while(|(row, _)| *row == last);
        let rest =
            rest.filter(|change| last > after && changed.last().is_some_and(|end| change > end));
        let all = changed.iter().copied().chain(rest);
        all.filter_map(|(_, id)| self.news(id)).collect()
    }

    fn news(&self, id: &str) -> Option<News> {
        if let Some(incident) = self.standing.get(id) {
            return Some(News::Changed(Arc::clone(incident)));
        }
        self.gone.get(id).map(|(row, into)| News::Gone {
            row: *row,
            id: id.to_owned(),
            into: into.clone(),
        })
    }
}
