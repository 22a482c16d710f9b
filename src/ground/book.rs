//! The book of what stands: newest revision of every alarm, which alarms are one incident, and what
//! operators said. One thread writes it; nothing here touches a disk or a clock.
//!
//! Bound: [`MAX_ALARMS`]. Loss: the incidents that changed longest ago leave the book; they stay on
//! disk, and their alarms come back into it when the aircraft tells of them again.

use super::action::{Action, Kind};
use super::incident::{Circumstances, Incident, News, Operator, Part};
use super::merge::fuse::Estimate;
use super::merge::{self, JOIN, LEAVE, Pins, Sighting, distance2, may_reach};
use super::store::Rank;
use crate::alarm::Alarm;
use emberfix_frames::{Coordinate, Ecef, Metres, Vector3};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

/// Alarms in the book.
pub(super) const MAX_ALARMS: usize = 10_000;
/// Farther apart, two alarms are never one incident; also the edge of a cell of the grid, metres.
const MAX_APART_M: f64 = 2_000.0;
/// Alarms that are looked at together; beyond, the farthest are left where they are.
const MAX_TOGETHER: usize = 48;

/// One alarm as the book has it.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    pub alarm: Alarm,
    pub rank: Rank,
    /// Row at which this revision came.
    pub row: i64,
    /// Row at which it first came: the oldest alarm of an incident names it.
    pub first_row: i64,
    /// Revisions on record.
    pub revisions: u64,
    /// Id of the incident that has it.
    pub incident: String,
    place_m: Vector3<f64>,
    operator: Operator,
    /// Numbers of the actions that name it, in order; its aircraft should learn of the last.
    said: Vec<i64>,
    chip: bool,
}

/// An alarm as it comes into the book.
#[derive(Debug, Clone)]
pub(super) struct Came {
    pub alarm: Alarm,
    pub rank: Rank,
    pub row: i64,
}

/// See the module.
#[derive(Debug, Default)]
pub(super) struct Book {
    entries: BTreeMap<String, Entry>,
    groups: BTreeMap<String, Group>,
    grid: HashMap<[i64; 3], BTreeSet<String>>,
    pins: Pins,
    actions: BTreeMap<i64, Action>,
    /// Up to which number each aircraft has fetched.
    fetched: BTreeMap<String, i64>,
    exercise: bool,
    /// Whether something was left out or has left.
    forgetful: bool,
    /// Alarms that are not on disk as they are here.
    dirty: BTreeSet<String>,
}

#[derive(Debug, Clone, Default)]
struct Group {
    alarms: Vec<String>,
    row: i64,
}

impl Book {
    pub fn new(exercise: bool) -> Self {
        Self {
            exercise,
            ..Self::default()
        }
    }

    /// What is known of an alarm.
    pub fn entry(&self, alarm: &str) -> Option<&Entry> {
        self.entries.get(alarm)
    }

    /// All alarms.
    pub fn alarm_ids(&self) -> impl Iterator<Item = &str> {
        self.entries.keys().map(String::as_str)
    }

    /// True when an alarm that is not in the book may still be on disk.
    pub fn is_forgetful(&self) -> bool {
        self.forgetful
    }

    /// The disk has more than was loaded.
    pub fn forgets(&mut self) {
        self.forgetful = true;
    }

    /// Puts an alarm where the disk says that it belongs.
    pub fn load(&mut self, came: Came, first_row: i64, revisions: u64, home: &str) {
        let id = came.alarm.properties.id.clone();
        self.put(came, first_row, revisions, home);
        self.dirty.remove(&id);
        self.enter(home, &id);
    }

    /// Takes an alarm in that was never merged: from the disk of an older program.
    pub fn adopt(&mut self, came: Came, first_row: i64, revisions: u64) -> Vec<News> {
        let (id, row) = (came.alarm.properties.id.clone(), came.row);
        self.put(came, first_row, revisions, &id);
        self.enter(&id, &id);
        self.regroup(&id, row)
    }

    fn enter(&mut self, incident: &str, alarm: &str) {
        let group = self.groups.entry(incident.to_owned()).or_default();
        if !group.alarms.iter().any(|known| known == alarm) {
            group.alarms.push(alarm.to_owned());
        }
    }

    /// Alarms that have to be written again.
    pub fn take_dirty(&mut self) -> BTreeSet<String> {
        std::mem::take(&mut self.dirty)
    }

    /// After loading: every incident as it stands, at the row that the disk gives for it.
    pub fn loaded(&mut self, rows: &BTreeMap<String, i64>) -> Vec<News> {
        let ids: Vec<String> = self.groups.keys().cloned().collect();
        for id in &ids {
            self.sort(id);
            let row = rows.get(id).copied().unwrap_or_default();
            if let Some(group) = self.groups.get_mut(id) {
                group.row = row;
            }
        }
        ids.iter().filter_map(|id| self.news(id)).collect()
    }

    /// A revision that was there already, or came late: it is history only.
    pub fn count(&mut self, alarm: &str, row: i64) -> Vec<News> {
        let Some(entry) = self.entries.get_mut(alarm) else {
            return Vec::new();
        };
        entry.revisions += 1;
        let home = entry.incident.clone();
        self.dirty.insert(alarm.to_owned());
        self.touch(&home, row)
    }

    /// Takes a revision that tells something new; what changed on the screens.
    pub fn take(&mut self, came: Came) -> Vec<News> {
        let (id, row) = (came.alarm.properties.id.clone(), came.row);
        let (first_row, revisions, home) = match self.entries.get(&id) {
            Some(known) => (known.first_row, known.revisions + 1, known.incident.clone()),
            None => (row, 1, id.clone()),
        };
        self.put(came, first_row, revisions, &home);
        self.enter(&home, &id);
        self.regroup(&id, row)
    }

    fn put(&mut self, came: Came, first_row: i64, revisions: u64, home: &str) {
        let Came { alarm, rank, row } = came;
        let id = alarm.properties.id.clone();
        let place_m = Coordinate::<Ecef>::from_wgs84(&alarm.place).metres();
        let before = self.entries.remove(&id);
        if let Some(before) = &before {
            self.leave(&id, before.place_m);
        }
        self.grid
            .entry(cell(place_m))
            .or_default()
            .insert(id.clone());
        let is_new = before.is_none();
        let (operator, said, chip) = before.map_or_else(Default::default, |entry| {
            (entry.operator, entry.said, entry.chip)
        });
        let incident = home.to_owned();
        let entry = Entry {
            alarm,
            rank,
            row,
            first_row,
            revisions,
            incident,
            place_m,
            operator,
            said,
            chip,
        };
        self.entries.insert(id.clone(), entry);
        if is_new && !self.actions.is_empty() {
            self.recollect(&id);
        }
        self.dirty.insert(id);
    }

    /// What was said of an alarm before it came into the book.
    fn recollect(&mut self, id: &str) {
        let names = |action: &&Action| action.names(id);
        let said = self
            .actions
            .values()
            .filter(names)
            .map(|action| action.number)
            .collect();
        if let Some(entry) = self.entries.get_mut(id) {
            entry.said = said;
        }
        self.listen(id);
    }

    fn leave(&mut self, id: &str, place_m: Vector3<f64>) {
        let key = cell(place_m);
        if let Some(there) = self.grid.get_mut(&key) {
            there.remove(id);
            if there.is_empty() {
                self.grid.remove(&key);
            }
        }
    }

    // --- merging -------------------------------------------------------------------------------

    /// Looks again at who is one fire with this alarm. `row` is that of what happened.
    fn regroup(&mut self, alarm: &str, row: i64) -> Vec<News> {
        let around = self.around(alarm);
        let before: BTreeSet<String> = around
            .iter()
            .filter_map(|id| self.entries.get(id).map(|entry| entry.incident.clone()))
            .collect();
        let sightings: Vec<Sighting<'_>> =
            around.iter().filter_map(|id| self.sighting(id)).collect();
        let groups: Vec<Vec<String>> = merge::partition(&sightings, &self.pins)
            .into_iter()
            .map(|group| {
                group
                    .into_iter()
                    .map(|at| sightings[at].alarm.to_owned())
                    .collect()
            })
            .collect();
        self.settle(&before, groups, alarm, row)
    }

    /// Puts groups in the place of the incidents that they are made from.
    fn settle(
        &mut self,
        before: &BTreeSet<String>,
        groups: Vec<Vec<String>>,
        changed: &str,
        row: i64,
    ) -> Vec<News> {
        let old: BTreeMap<String, Group> = before
            .iter()
            .filter_map(|id| self.groups.remove(id).map(|group| (id.clone(), group)))
            .collect();
        let mut touched = BTreeSet::new();
        for mut alarms in groups {
            alarms.sort_by_key(|id| self.first_row(id));
            let Some(id) = alarms.first().cloned() else {
                continue;
            };
            let same = old.get(&id).filter(|group| group.alarms == alarms);
            let mut at = same.map_or(row, |group| group.row);
            if same.is_none() || alarms.iter().any(|alarm| alarm == changed) {
                at = row;
                touched.insert(id.clone());
            }
            for alarm in &alarms {
                match self.entries.get_mut(alarm) {
                    Some(entry) if entry.incident != id => entry.incident.clone_from(&id),
                    _ => continue,
                }
                self.dirty.insert(alarm.clone());
            }
            self.groups.insert(id, Group { alarms, row: at });
        }
        self.tell(old.keys(), &touched, row)
    }

    fn tell<'a>(
        &self,
        old: impl Iterator<Item = &'a String>,
        touched: &BTreeSet<String>,
        row: i64,
    ) -> Vec<News> {
        let gone = old
            .filter(|id| !self.groups.contains_key(*id))
            .filter_map(|id| {
                let into = self.entries.get(id)?.incident.clone();
                Some(News::Gone {
                    row,
                    id: id.clone(),
                    into,
                })
            });
        let mut news: Vec<News> = gone.collect();
        news.extend(touched.iter().filter_map(|id| self.news(id)));
        news
    }

    /// Alarms of all incidents that have to be looked at with this alarm, itself among them.
    fn around(&self, alarm: &str) -> Vec<String> {
        let Some(entry) = self.entries.get(alarm) else {
            return Vec::new();
        };
        let mut incidents = vec![entry.incident.clone()];
        let partners = self
            .pins
            .partners(alarm)
            .filter_map(|id| self.entries.get(id));
        let partners: Vec<String> = partners.map(|entry| entry.incident.clone()).collect();
        for incident in partners.into_iter().chain(self.near(entry)) {
            if !incidents.contains(&incident) {
                incidents.push(incident);
            }
        }
        let mut around: Vec<String> = Vec::new();
        for group in incidents.iter().filter_map(|id| self.groups.get(id)) {
            if !around.is_empty() && around.len() + group.alarms.len() > MAX_TOGETHER {
                break;
            }
            around.extend(group.alarms.iter().cloned());
        }
        around
    }

    /// Incidents with an alarm within the gate, nearest first.
    fn near(&self, entry: &Entry) -> Vec<String> {
        let [x, y, z] = cell(entry.place_m);
        let offsets =
            (-1..=1).flat_map(|a| (-1..=1).flat_map(move |b| (-1..=1).map(move |c| [a, b, c])));
        let mut near: Vec<(f64, &str)> = offsets
            .filter_map(|[a, b, c]| self.grid.get(&[x + a, y + b, z + c]))
            .flatten()
            .filter_map(|id| self.gated(entry, self.entries.get(id)?))
            .collect();
        near.sort_by(|(a, one), (b, other)| a.total_cmp(b).then_with(|| one.cmp(other)));
        let mut incidents: Vec<String> = Vec::new();
        for (_, incident) in near {
            if !incidents.iter().any(|known| known == incident) {
                incidents.push(incident.to_owned());
            }
        }
        incidents
    }

    fn gated<'a>(&self, entry: &Entry, other: &'a Entry) -> Option<(f64, &'a str)> {
        let apart_m = (entry.place_m - other.place_m).norm();
        if other.alarm.properties.uav == entry.alarm.properties.uav || apart_m > MAX_APART_M {
            return None;
        }
        let (one, two) = (sighting(entry), sighting(other));
        if !may_reach(&one, &two, apart_m) {
            return None;
        }
        let distance2 = distance2(&one, &two);
        let limit = if other.incident == entry.incident {
            LEAVE
        } else {
            JOIN
        };
        (distance2 <= limit).then_some((distance2, other.incident.as_str()))
    }

    fn sighting(&self, id: &str) -> Option<Sighting<'_>> {
        self.entries.get(id).map(sighting)
    }

    fn first_row(&self, id: &str) -> i64 {
        self.entries
            .get(id)
            .map_or(i64::MAX, |entry| entry.first_row)
    }

    fn sort(&mut self, id: &str) {
        let Some(mut group) = self.groups.remove(id) else {
            return;
        };
        group.alarms.sort_by_key(|alarm| self.first_row(alarm));
        self.groups.insert(id.to_owned(), group);
    }

    // --- operators -----------------------------------------------------------------------------

    /// Alarms of an incident, oldest first.
    pub fn alarms_of(&self, incident: &str) -> Option<&[String]> {
        self.groups
            .get(incident)
            .map(|group| group.alarms.as_slice())
    }

    /// An action by its number.
    pub fn action(&self, number: i64) -> Option<&Action> {
        self.actions.get(&number)
    }

    /// Carries out what an operator ordered, as it stands on disk; what changed on the screens.
    pub fn act(&mut self, action: &Action) -> Vec<News> {
        self.remember(action);
        let mut news = Vec::new();
        let mut alarms: Vec<String> = action.alarms.clone();
        alarms.extend(action.others.iter().cloned());
        for alarm in alarms {
            news.extend(self.regroup(&alarm, action.row));
        }
        newest_only(news)
    }

    /// Takes an action into account without looking at groups again: the disk has them.
    pub fn remember(&mut self, action: &Action) {
        let number = action.number;
        match action.kind {
            Kind::Acknowledge | Kind::Confirm | Kind::Dismiss => {}
            Kind::Merge => self.pin(action, true),
            Kind::Split => self.pin(action, false),
            Kind::Undo => self.undo(action.of),
        }
        self.actions.insert(number, action.clone());
        for alarm in action.alarms.iter().chain(&action.others) {
            if let Some(entry) = self.entries.get_mut(alarm) {
                entry.said.push(number);
            }
            self.listen(alarm);
        }
    }

    fn pin(&mut self, action: &Action, together: bool) {
        for one in &action.alarms {
            for other in action.others.iter().filter(|other| *other != one) {
                self.pins.set(one, other, action.number, together);
            }
        }
    }

    fn undo(&mut self, of: Option<i64>) {
        let Some(of) = of else { return };
        self.pins.undo(of);
        if let Some(undone) = self.actions.get_mut(&of) {
            undone.undone = true;
        }
    }

    /// The incident that an id stands for, which may have gone into another.
    pub fn home(&self, id: &str) -> Option<&str> {
        if self.groups.contains_key(id) {
            return self.groups.get_key_value(id).map(|(id, _)| id.as_str());
        }
        self.entries.get(id).map(|entry| entry.incident.as_str())
    }

    /// What was last said of an alarm and not taken back.
    fn listen(&mut self, alarm: &str) {
        let Some(entry) = self.entries.get_mut(alarm) else {
            return;
        };
        let last = entry
            .said
            .iter()
            .rev()
            .filter_map(|number| self.actions.get(number))
            .find(|action| {
                let is_meant = action.alarms.iter().any(|id| id == alarm);
                !action.undone && action.state().is_some() && is_meant
            });
        entry.operator = last.map(Action::operator).unwrap_or_default();
    }

    /// An aircraft has fetched everything up to this number.
    pub fn fetched(&mut self, uav: &str, number: i64, row: i64) -> Vec<News> {
        let before = self
            .fetched
            .insert(uav.to_owned(), number)
            .unwrap_or_default();
        let learnt = |entry: &&Entry| {
            entry.alarm.properties.uav == uav
                && entry
                    .said
                    .last()
                    .is_some_and(|told| *told > before && *told <= number)
        };
        let homes: BTreeSet<String> = self
            .entries
            .values()
            .filter(learnt)
            .map(|entry| entry.incident.clone())
            .collect();
        homes
            .iter()
            .flat_map(|home| self.touch(home, row))
            .collect()
    }

    /// Up to which number an aircraft has fetched.
    pub fn fetched_by(&self, uav: &str) -> i64 {
        self.fetched.get(uav).copied().unwrap_or_default()
    }

    /// There is an image of this alarm.
    pub fn has_chip(&mut self, alarm: &str, row: i64) -> Vec<News> {
        let Some(entry) = self.entries.get_mut(alarm) else {
            return Vec::new();
        };
        entry.chip = true;
        let home = entry.incident.clone();
        self.touch(&home, row)
    }

    // --- what stands ---------------------------------------------------------------------------

    fn touch(&mut self, incident: &str, row: i64) -> Vec<News> {
        if let Some(group) = self.groups.get_mut(incident) {
            group.row = group.row.max(row);
        }
        self.news(incident).into_iter().collect()
    }

    fn news(&self, id: &str) -> Option<News> {
        self.incident(id)
            .map(|incident| News::Changed(Arc::new(incident)))
    }

    fn incident(&self, id: &str) -> Option<Incident> {
        let group = self.groups.get(id)?;
        let entries: Vec<&Entry> = group
            .alarms
            .iter()
            .filter_map(|alarm| self.entries.get(alarm))
            .collect();
        let parts: Vec<Part<'_>> = entries.iter().map(|entry| self.part(entry)).collect();
        let about = Circumstances {
            id: id.to_owned(),
            row: group.row,
            history: entries
                .iter()
                .map(|entry| entry.revisions + entry.said.len() as u64)
                .sum(),
            chip: entries.iter().any(|entry| entry.chip),
            exercise: self.exercise,
        };
        Incident::of(&parts, about)
    }

    fn part<'a>(&self, entry: &'a Entry) -> Part<'a> {
        let fetched = self.fetched_by(&entry.alarm.properties.uav);
        Part {
            alarm: &entry.alarm,
            operator: &entry.operator,
            aircraft_knows: entry.said.last().map(|told| *told <= fetched),
        }
    }

    /// Makes room: ids of incidents that left the book.
    pub fn make_room(&mut self) -> Vec<String> {
        let mut left = Vec::new();
        if self.entries.len() <= MAX_ALARMS {
            return left;
        }
        let mut oldest: Vec<(i64, String)> = self
            .groups
            .iter()
            .map(|(id, group)| (group.row, id.clone()))
            .collect();
        oldest.sort();
        for (_, id) in oldest {
            // A tenth at once, so that the sorting is worth it.
            if self.entries.len() <= MAX_ALARMS - MAX_ALARMS / 10 {
                break;
            }
            for alarm in self.groups.remove(&id).unwrap_or_default().alarms {
                if let Some(entry) = self.entries.remove(&alarm) {
                    self.leave(&alarm, entry.place_m);
                }
            }
            left.push(id);
        }
        self.forgetful = true;
        left
    }
}

/// Of several changes to one incident, the last.
fn newest_only(news: Vec<News>) -> Vec<News> {
    let mut last: BTreeMap<String, News> = BTreeMap::new();
    for news in news {
        last.insert(news.id().to_owned(), news);
    }
    last.into_values().collect()
}

fn cell(place_m: Vector3<f64>) -> [i64; 3] {
    // Earth's radius over the edge: far within an i64.
    [0, 1, 2].map(|axis| (place_m[axis] / MAX_APART_M).floor() as i64)
}

fn sighting(entry: &Entry) -> Sighting<'_> {
    let alarm = &entry.alarm.properties;
    Sighting {
        alarm: &alarm.id,
        uav: &alarm.uav,
        estimate: Estimate::of(&entry.alarm),
        width_m: alarm
            .size_m
            .map_or(0.0, |size| size.width.clamp(0.0, 100.0)),
        home: &entry.incident,
    }
}
