//! What one receiver has been told, and what it should be told next.
//!
//! There is no queue to overflow: what is due is the difference between how things stand and what
//! this receiver last heard, so a slow or absent one costs one entry per incident and gets the
//! newest of each when it comes back.

use super::view;
use crate::ground::incident::Incident;
use emberfix_frames::{ServiceTime, SignedDuration};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Incidents that a receiver is told of at once. Beyond it, those that changed longest ago are left
/// out; they are still on the page and in the store.
pub(super) const MAX_TOLD: usize = 1_000;

/// What a receiver should hear of an incident.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Word {
    /// How it stands.
    Stands(Arc<Incident>),
    /// That it is no more: dismissed, or part of another.
    Gone(String),
}

/// Memory of one receiver.
#[derive(Debug, Clone, Default)]
pub(super) struct Told {
    by_id: BTreeMap<String, Last>,
}

#[derive(Debug, Clone, Copy)]
struct Last {
    row: i64,
    at: ServiceTime,
    /// How often it was said that it is gone.
    farewells: u8,
}

/// How often things are said.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rhythm {
    /// What stands is said again after this long: for who came later, and so that it does not go stale.
    pub repeat: SignedDuration,
    /// How often the end is said; a datagram may be lost.
    pub farewells: u8,
    /// What ended longer ago than this is not said any more: its marker has gone stale.
    pub forget: SignedDuration,
}

impl Told {
    /// What is due; `incidents` are newest first.
    pub(super) fn due(
        &self,
        incidents: &[Arc<Incident>],
        now: ServiceTime,
        rhythm: Rhythm,
    ) -> Vec<Word> {
        let told = incidents.iter().take(MAX_TOLD);
        let standing: BTreeSet<&str> = told.clone().map(|incident| incident.id.as_str()).collect();
        let words = told.filter_map(|incident| self.word(incident, now, rhythm));
        let absent = self.by_id.iter().filter(|(id, last)| {
            !standing.contains(id.as_str()) && last.farewells < rhythm.farewells
        });
        words
            .chain(absent.map(|(id, _)| Word::Gone(id.clone())))
            .collect()
    }

    fn word(&self, incident: &Arc<Incident>, now: ServiceTime, rhythm: Rhythm) -> Option<Word> {
        let last = self.by_id.get(&incident.id);
        let is_recent = now - view::changed_at(incident) < rhythm.forget;
        if view::is_shown(incident) {
            let is_news = last.is_none_or(|last| last.row != incident.row);
            let is_old = last.is_some_and(|last| now - last.at >= rhythm.repeat);
            let is_current = view::is_open(incident) || is_recent;
            return (is_current && (is_news || is_old)).then(|| Word::Stands(Arc::clone(incident)));
        }
        // Whoever was told before we started may still show it.
        let farewells = last.map_or(0, |last| last.farewells);
        let may_be_shown = last.is_some() || is_recent;
        (may_be_shown && farewells < rhythm.farewells).then(|| Word::Gone(incident.id.clone()))
    }

    /// Remembers that it was said.
    pub(super) fn said(&mut self, word: &Word, now: ServiceTime) {
        match word {
            Word::Stands(incident) => {
                let last = Last {
                    row: incident.row,
                    at: now,
                    farewells: 0,
                };
                self.by_id.insert(incident.id.clone(), last);
            }
            Word::Gone(id) => {
                let last = self.by_id.entry(id.clone()).or_insert(Last {
                    row: 0,
                    at: now,
                    farewells: 0,
                });
                last.farewells = last.farewells.saturating_add(1);
            }
        }
    }

    /// Forgets what has been taken leave of and is not there any more.
    pub(super) fn forget(&mut self, incidents: &[Arc<Incident>], rhythm: Rhythm) {
        if self.by_id.len() <= 2 * MAX_TOLD {
            return;
        }
        let standing: BTreeSet<&str> = incidents
            .iter()
            .map(|incident| incident.id.as_str())
            .collect();
        self.by_id
            .retain(|id, last| standing.contains(id.as_str()) || last.farewells < rhythm.farewells);
    }
}
