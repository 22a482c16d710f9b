use super::*;
use crate::alarm::FireState;
use crate::deliver::tests_support::alarm;

const NOW: ServiceTime = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);
const LINKS: [&str; 2] = ["mavlink", "ip"];

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }
    fn path(&self) -> PathBuf {
        self.0.path().join("outbox.sqlite")
    }
    fn open(&self) -> Outbox {
        Outbox::open(&self.path(), &LINKS, owner()).unwrap()
    }
}

fn owner() -> Owner {
    Owner {
        uav: "uav-1".to_owned(),
        key: None,
    }
}

fn ids(outbox: &mut Outbox, link: &str) -> Vec<(String, u32)> {
    let pending = outbox.pending(link, 100).unwrap().into_iter();
    pending
        .map(|letter| (letter.id().to_owned(), letter.revision()))
        .collect()
}

#[test]
fn what_was_put_survives_a_restart_as_it_was() {
    let place = Place::new();
    place.open().put(&alarm(1, 1), NOW).unwrap();
    let back = place.open().pending("mavlink", 10).unwrap();
    assert_eq!(back.len(), 1);
    assert_eq!(back[0].alarm.properties, alarm(1, 1).properties);
}

#[test]
fn a_receipt_is_per_link_and_survives_a_restart() {
    let place = Place::new();
    let mut outbox = place.open();
    outbox.put(&alarm(1, 1), NOW).unwrap();
    outbox.acknowledge("ip", "uav-1-1", 1).unwrap();
    drop(outbox);
    let mut outbox = place.open();
    assert_eq!(ids(&mut outbox, "ip"), []);
    assert_eq!(ids(&mut outbox, "mavlink"), [("uav-1-1".to_owned(), 1)]);
}

#[test]
fn a_newer_revision_replaces_and_an_older_one_does_not() {
    let mut outbox = Place::new().open();
    assert_eq!(outbox.put(&alarm(1, 2), NOW).unwrap(), Put::Stored);
    assert_eq!(outbox.put(&alarm(1, 1), NOW).unwrap(), Put::Superseded);
    assert_eq!(outbox.put(&alarm(1, 3), NOW).unwrap(), Put::Stored);
    assert_eq!(ids(&mut outbox, "ip"), [("uav-1-1".to_owned(), 3)]);
}

#[test]
fn a_late_receipt_of_an_old_revision_does_not_settle_the_new_one() {
    let mut outbox = Place::new().open();
    outbox.put(&alarm(1, 1), NOW).unwrap();
    outbox.put(&alarm(1, 2), NOW).unwrap();
    outbox.acknowledge("ip", "uav-1-1", 1).unwrap();
    assert_eq!(outbox.waiting("ip").unwrap(), 1);
    outbox.acknowledge("ip", "uav-1-1", 2).unwrap();
    outbox.acknowledge("ip", "uav-1-1", 1).unwrap();
    assert_eq!(outbox.waiting("ip").unwrap(), 0);
}

#[test]
fn a_burning_fire_goes_before_one_that_is_out() {
    let mut outbox = Place::new().open();
    let mut out = alarm(1, 4);
    out.properties.state = FireState::Out;
    outbox.put(&out, NOW).unwrap();
    outbox.put(&alarm(2, 1), NOW).unwrap();
    outbox.put(&alarm(3, 1), NOW).unwrap();
    let order: Vec<String> = ids(&mut outbox, "ip")
        .into_iter()
        .map(|(id, _)| id)
        .collect();
    assert_eq!(order, ["uav-1-2", "uav-1-3", "uav-1-1"]);
}

#[test]
fn fire_numbers_never_come_twice() {
    let place = Place::new();
    assert_eq!(place.open().next_fire_number().unwrap(), FireId(1));
    assert_eq!(place.open().next_fire_number().unwrap(), FireId(2));
    place.open().put(&alarm(9, 1), NOW).unwrap();
    assert_eq!(place.open().next_fire_number().unwrap(), FireId(10));
}

#[test]
fn one_unreadable_alarm_does_not_block_the_others() {
    let mut outbox = Place::new().open();
    outbox.put(&alarm(1, 1), NOW).unwrap();
    outbox.put(&alarm(2, 1), NOW).unwrap();
    outbox
        .database
        .execute("UPDATE alarms SET json = '{' WHERE id = 'uav-1-1'", [])
        .unwrap();
    assert_eq!(ids(&mut outbox, "ip"), [("uav-1-2".to_owned(), 1)]);
    assert_eq!((outbox.unreadable(), outbox.waiting("ip").unwrap()), (1, 1));
}

#[test]
fn an_outbox_of_a_later_program_is_refused_and_left_alone() {
    let place = Place::new();
    place
        .open()
        .database
        .pragma_update(None, "user_version", layout::NEWEST + 1)
        .unwrap();
    let refused = Outbox::open(&place.path(), &LINKS, owner()).unwrap_err();
    assert!(matches!(
        refused,
        OutboxError::Newer {
            found: 4,
            known: 3,
            ..
        }
    ));
}

#[test]
fn two_services_cannot_hold_one_outbox() {
    let place = Place::new();
    let _first = place.open();
    assert!(matches!(
        Outbox::open(&place.path(), &LINKS, owner()),
        Err(OutboxError::Open { .. })
    ));
}

#[test]
fn delivered_alarms_are_pruned_and_waiting_ones_are_not() {
    let mut outbox = Place::new().open();
    let delivered = Outbox::KEEP_DELIVERED + 5;
    outbox
        .database
        .pragma_update(None, "synchronous", "OFF")
        .unwrap();
    outbox.put(&alarm(1, 1), NOW).unwrap();
    for number in 2..2 + delivered {
        let mut later = alarm(number, 1);
        later.properties.captured_at =
            later.properties.captured_at + emberfix_frames::seconds(f64::from(number));
        outbox.put(&later, NOW).unwrap();
        for link in LINKS {
            outbox
                .acknowledge(link, &format!("uav-1-{number}"), 1)
                .unwrap();
        }
    }
    let count = |sql| {
        outbox
            .database
            .query_row(sql, [], |row| row.get::<_, u32>(0))
            .unwrap()
    };
    assert_eq!(
        count("SELECT count(*) FROM alarms"),
        Outbox::KEEP_DELIVERED + 1
    );
    assert_eq!(count("SELECT count(*) FROM alarms WHERE id = 'uav-1-1'"), 1);
    assert_eq!(
        count("SELECT count(*) FROM receipts"),
        2 * Outbox::KEEP_DELIVERED
    );
}

/// The environment variable makes this very test binary the process that is killed.
#[test]
fn a_kill_right_after_put_loses_nothing() {
    const VICTIM: &str = "EMBERFIX_TEST_OUTBOX_VICTIM";
    if let Some(path) = std::env::var_os(VICTIM) {
        let mut outbox = Outbox::open(Path::new(&path), &LINKS, owner()).unwrap();
        outbox.put(&alarm(1, 1), NOW).unwrap();
        std::process::abort();
    }
    let place = Place::new();
    let name = "deliver::outbox::tests::a_kill_right_after_put_loses_nothing";
    let status = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", name])
        .env(VICTIM, place.path())
        .output()
        .unwrap()
        .status;
    assert!(!status.success());
    assert_eq!(
        ids(&mut place.open(), "mavlink"),
        [("uav-1-1".to_owned(), 1)]
    );
}

/// A layout that this program wrote before: its alarms get numbers, and stay owed.
#[test]
fn an_older_outbox_is_renewed_and_loses_nothing() {
    let place = Place::new();
    let old = Connection::open(place.path()).unwrap();
    old.execute_batch(layout::FIRST).unwrap();
    old.pragma_update(None, "user_version", 1).unwrap();
    for number in [3, 5] {
        let alarm = alarm(number, 2);
        old.execute(
            "INSERT INTO alarms (id, revision, urgency, json, captured_at_ns, stored_at_ns)
             VALUES (?1, 2, 0, ?2, 0, 0)",
            params![alarm.properties.id, alarm.to_geojson().to_string()],
        )
        .unwrap();
    }
    old.execute("INSERT INTO receipts VALUES ('http', 'uav-1-3', 2)", [])
        .unwrap();
    drop(old);
    let mut outbox = place.open();
    assert_eq!(ids(&mut outbox, "ip"), [("uav-1-5".to_owned(), 2)]);
    assert_eq!(outbox.newest_sequence().unwrap(), 2);
    outbox.put(&alarm(5, 3), NOW).unwrap();
    let letter = outbox.pending("ip", 1).unwrap().remove(0);
    assert_eq!((letter.sequence(), letter.sealed.envelope.count), (3, 2));
}

#[test]
fn every_revision_has_a_number_and_says_for_how_many_it_stands() {
    let place = Place::new();
    let mut outbox = place.open();
    outbox.put(&alarm(1, 1), NOW).unwrap();
    outbox.put(&alarm(2, 1), NOW).unwrap();
    outbox.put(&alarm(1, 2), NOW).unwrap();
    outbox.put(&alarm(1, 2), NOW).unwrap();
    let origin = outbox.origin();
    drop(outbox);
    let mut outbox = place.open();
    outbox.put(&alarm(1, 7), NOW).unwrap();
    let numbers = |letter: &Letter| {
        let envelope = &letter.sealed.envelope;
        (envelope.sequence, envelope.count)
    };
    let pending = outbox.pending("ip", 10).unwrap();
    let numbers: Vec<_> = pending.iter().map(numbers).collect();
    assert_eq!(numbers, [(4, 3), (2, 1)]);
    assert_eq!(
        (outbox.newest_sequence().unwrap(), outbox.origin()),
        (4, origin)
    );
}

#[test]
fn letters_are_signed_over_the_bytes_that_are_on_disk() {
    let place = Place::new();
    let key = SecretKey::random();
    let owner = Owner {
        uav: "uav-1".to_owned(),
        key: Some(key.clone()),
    };
    let mut outbox = Outbox::open(&place.path(), &LINKS, owner).unwrap();
    outbox.put(&alarm(1, 1), NOW).unwrap();
    let letter = outbox.pending("ip", 1).unwrap().remove(0);
    assert!(letter.sealed.is_signed_by(&key.public()));
    let bytes = alarm(1, 1).to_geojson().to_string();
    assert_eq!(letter.sealed.envelope.alarm, bytes.as_bytes());
}

#[test]
fn a_changed_digit_is_set_aside_and_never_signed() {
    let place = Place::new();
    let mut outbox = place.open();
    outbox.put(&alarm(1, 1), NOW).unwrap();
    outbox.put(&alarm(2, 1), NOW).unwrap();
    let moved = "UPDATE alarms SET json = replace(json, '0.91', '0.19') WHERE id = 'uav-1-1'";
    assert_eq!(outbox.database.execute(moved, []).unwrap(), 1);
    assert_eq!(ids(&mut outbox, "ip"), [("uav-1-2".to_owned(), 1)]);
    assert_eq!(outbox.unreadable(), 1);
    // A newer revision is whole again.
    outbox.put(&alarm(1, 2), NOW).unwrap();
    assert_eq!(ids(&mut outbox, "ip").len(), 2);
}

fn action(number: u64, kind: ActionKind) -> Action {
    Action {
        number,
        alarm: "uav-1-1".to_owned(),
        kind,
        at: NOW,
        by: String::new(),
    }
}

#[test]
fn an_operators_action_survives_a_restart_and_is_taken_once() {
    let place = Place::new();
    let mut outbox = place.open();
    outbox.put(&alarm(1, 1), NOW).unwrap();
    assert!(outbox.take_action(&action(4, ActionKind::Dismiss)).unwrap());
    assert!(!outbox.take_action(&action(4, ActionKind::Dismiss)).unwrap());
    assert!(!outbox.take_action(&action(3, ActionKind::Confirm)).unwrap());
    drop(outbox);
    let mut outbox = place.open();
    assert_eq!(outbox.newest_action().unwrap(), 4);
    let attention = |outbox: &mut Outbox| outbox.pending("ip", 1).unwrap()[0].attention;
    assert_eq!(attention(&mut outbox), Attention::Dismissed);
    assert!(outbox.take_action(&action(5, ActionKind::Merge)).unwrap());
    assert_eq!(attention(&mut outbox), Attention::Dismissed);
    assert!(outbox.take_action(&action(6, ActionKind::Undo)).unwrap());
    assert_eq!(attention(&mut outbox), Attention::Wanted);
}

#[test]
fn nothing_changed_is_seen_without_reading() {
    let mut outbox = Place::new().open();
    let before = outbox.changes();
    outbox.pending("ip", 10).unwrap();
    assert_eq!(outbox.changes(), before);
    outbox.put(&alarm(1, 1), NOW).unwrap();
    assert!(outbox.changes() > before);
}

#[test]
fn a_fires_newest_picture_waits_until_the_ground_has_it_over_restarts_too() {
    let place = Place::new();
    let mut outbox = place.open();
    let before = outbox.changes();
    assert!(outbox.put_chip("uav-1-1", 1, &[1; 100]).unwrap());
    assert!(outbox.put_chip("uav-1-2", 1, &[2; 100]).unwrap());
    assert!(outbox.put_chip("uav-1-1", 4, &[3; 100]).unwrap());
    assert!(outbox.changes() > before, "the courier has to look");
    drop(outbox);
    let mut outbox = place.open();
    let waiting = outbox.chips_after(0).unwrap();
    let named = |chips: &[StoredChip]| -> Vec<(String, u32)> {
        chips.iter().map(|c| (c.id.clone(), c.revision)).collect()
    };
    assert_eq!(
        named(&waiting),
        [("uav-1-2".into(), 1), ("uav-1-1".into(), 4)]
    );
    assert_eq!(waiting[1].jpeg, [3; 100]);
    assert_eq!(outbox.chips_after(waiting[0].number).unwrap(), waiting[1..]);
    // An answer that is late is about the older picture.
    outbox.drop_chip("uav-1-1", 3).unwrap();
    outbox.drop_chip("uav-1-2", 1).unwrap();
    assert_eq!(
        named(&outbox.chips_after(0).unwrap()),
        [("uav-1-1".into(), 4)]
    );
    for number in 10..40 {
        outbox
            .put_chip(&format!("uav-1-{number}"), 1, &[0; 10])
            .unwrap();
    }
    let waiting = outbox.chips_after(0).unwrap();
    assert_eq!(waiting.len(), Outbox::MAX_CHIPS as usize);
    assert_eq!(waiting[0].id, "uav-1-24");
}
