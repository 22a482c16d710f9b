//! What the outbox's disk may do to it: run full, tear the last write, flip bits.

use super::aircraft::a_fire;
use super::{Audit, DeliveryError, Found, Options, Told, io};
use crate::deliver::{DatagramDelivery, Outbox, OutboxError, Owner};
use crate::eval::Table;
use emberfix_frames::ServiceTime;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const LINK: &str = DatagramDelivery::NAME;
const NOW: ServiceTime = ServiceTime::from_unix_ns(1_772_366_400_000_000_000);
/// Alarms before the last one, whose write is torn.
const BEFORE: u32 = 3;
/// Where files can be copied thousands of times without wearing a disk.
const MEMORY: &str = "/dev/shm";

pub(super) fn measure(
    options: &Options,
    scratch: &Path,
    told: Told<'_>,
) -> Result<Found, DeliveryError> {
    let folder = Copies::new(scratch)?;
    let stride = if options.quick { 97 } else { 1 };
    told("torn writes");
    let torn = torn(&folder, stride)?;
    told("flipped bits");
    let flipped = flipped(&folder, if options.quick { 2_003 } else { 41 })?;
    told("full disk");
    let full = full(&folder)?;
    let count = |name: &str, value: usize| (name.to_owned(), serde_json::Value::from(value));
    Ok(Found {
        audit: torn.audit.plus(full.audit),
        details: [
            count("torn_writes", torn.cases),
            count("flipped_bytes", flipped.cases),
            count("flips_that_cost_an_alarm", flipped.costly),
            count("flips_that_were_believed", flipped.audit.lost),
            count("full_disk_stored", full.audit.put),
            count("full_disk_refused", full.cases),
        ]
        .into_iter()
        .collect(),
        tables: vec![table(&torn, &flipped, &full)],
        ..Found::default()
    })
}

/// What one kind of damage came to.
#[derive(Debug, Default)]
struct Damage {
    cases: usize,
    costly: usize,
    audit: Audit,
}

/// A folder in memory, gone afterwards.
struct Copies(PathBuf);

impl Copies {
    fn new(scratch: &Path) -> Result<Self, DeliveryError> {
        let memory = Path::new(MEMORY);
        let within = if memory.is_dir() { memory } else { scratch };
        let folder = within.join(format!("emberfix-disk-{}", uuid::Uuid::new_v4()));
        std::fs::create_dir_all(&folder).map_err(io("make a folder in memory"))?;
        Ok(Self(folder))
    }

    fn open(&self, name: &str) -> Result<Outbox, OutboxError> {
        let owner = Owner {
            uav: "uav-1".to_owned(),
            key: None,
        };
        Outbox::open(&self.0.join(name), &[LINK], owner)
    }
}

impl Drop for Copies {
    fn drop(&mut self) {
        // Memory is given back at the latest when the machine stops.
        let _gone = std::fs::remove_dir_all(&self.0);
    }
}

fn wal(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push("-wal");
    PathBuf::from(name)
}

/// Database and log as a power cut would leave them: three alarms, then a fourth.
struct Image {
    database: Vec<u8>,
    log: Vec<u8>,
    /// Length of the log before the fourth.
    before: usize,
}

fn image(folder: &Copies, name: &str) -> Result<Image, DeliveryError> {
    let path = folder.0.join(name);
    let read = |path: &Path| std::fs::read(path).map_err(io("read the outbox's files"));
    let mut outbox = folder.open(name)?;
    for number in 1..=BEFORE {
        outbox.put(&a_fire("uav-1", number, NOW)?, NOW)?;
    }
    let before = read(&wal(&path))?.len();
    outbox.put(&a_fire("uav-1", BEFORE + 1, NOW)?, NOW)?;
    Ok(Image {
        database: read(&path)?,
        log: read(&wal(&path))?,
        before,
    })
}

/// Opens such files in a place of their own; the ids that wait, or none when it can't be opened.
fn reopened(folder: &Copies, database: &[u8], log: &[u8]) -> Option<BTreeSet<String>> {
    let path = folder.0.join("copy.sqlite");
    std::fs::write(&path, database).ok()?;
    std::fs::write(wal(&path), log).ok()?;
    let mut outbox = folder.open("copy.sqlite").ok()?;
    let pending = outbox.pending(LINK, 100).ok()?;
    Some(
        pending
            .iter()
            .map(|letter| letter.id().to_owned())
            .collect(),
    )
}

fn ids(numbers: std::ops::RangeInclusive<u32>) -> BTreeSet<String> {
    numbers.map(|number| format!("uav-1-{number}")).collect()
}

/// The log is cut at every byte of the last write: all earlier alarms are there, and the last one if
/// its write is whole.
fn torn(folder: &Copies, stride: usize) -> Result<Damage, DeliveryError> {
    let image = image(folder, "torn.sqlite")?;
    let mut damage = Damage::default();
    let whole = image.log.len();
    let cuts = (image.before..whole).step_by(stride).chain([whole]);
    for cut in cuts {
        let expected = ids(1..=if cut == whole { BEFORE + 1 } else { BEFORE });
        let found = reopened(folder, &image.database, &image.log[..cut]);
        damage.cases += 1;
        damage.audit.put += expected.len();
        damage.audit.lost += match found {
            Some(found) => expected.difference(&found).count(),
            None => expected.len(),
        };
    }
    Ok(damage)
}

/// One bit of the log is flipped: an alarm may be lost, and then the outbox knows or never had it; a
/// changed one is never sent.
fn flipped(folder: &Copies, stride: usize) -> Result<Damage, DeliveryError> {
    let image = image(folder, "flipped.sqlite")?;
    let mut damage = Damage::default();
    for at in (0..image.log.len()).step_by(stride) {
        let mut log = image.log.clone();
        log[at] ^= 1 << (at % 8);
        let found = reopened(folder, &image.database, &log).unwrap_or_default();
        damage.cases += 1;
        damage.costly += usize::from(found.len() < ids(1..=BEFORE + 1).len());
        damage.audit.lost += found.difference(&ids(1..=BEFORE + 1)).count();
    }
    Ok(damage)
}

/// A disk that has room for a few alarms only: what was put is there, what was refused was refused.
fn full(folder: &Copies) -> Result<Damage, DeliveryError> {
    let mut damage = Damage::default();
    let Some(disk) = small_disk(&folder.0.join("small"))? else {
        return Ok(damage);
    };
    let owner = Owner {
        uav: "uav-1".to_owned(),
        key: None,
    };
    let path = disk.0.join("outbox.sqlite");
    let mut outbox = Outbox::open(&path, &[LINK], owner.clone())?;
    fill(&disk.0)?;
    let mut put = BTreeSet::new();
    for number in 1..=4_000 {
        match outbox.put(&a_fire("uav-1", number, NOW)?, NOW) {
            Ok(_) => {
                put.insert(format!("uav-1-{number}"));
            }
            Err(_) => damage.cases += 1,
        }
        if damage.cases >= 20 {
            break;
        }
    }
    drop(outbox);
    let mut outbox = Outbox::open(&path, &[LINK], owner)?;
    let there = outbox.pending(LINK, 10_000)?;
    let there: BTreeSet<String> = there.iter().map(|letter| letter.id().to_owned()).collect();
    damage.audit.put = put.len();
    damage.audit.lost = put.difference(&there).count();
    Ok(damage)
}

/// A disk of 24 MB in memory, unmounted afterwards.
struct SmallDisk(PathBuf);

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // A mount that stays behind holds memory until the machine stops.
        let _gone = std::process::Command::new("umount").arg(&self.0).status();
    }
}

/// None where disks can't be mounted: that needs root.
fn small_disk(folder: &Path) -> Result<Option<SmallDisk>, DeliveryError> {
    std::fs::create_dir_all(folder).map_err(io("make a folder to mount on"))?;
    let mut mount = std::process::Command::new("mount");
    mount
        .args(["-t", "tmpfs", "-o", "size=24m", "tmpfs"])
        .arg(folder);
    let mounted = mount.stderr(std::process::Stdio::null()).status();
    let mounted = mounted.is_ok_and(|status| status.success());
    Ok(mounted.then(|| SmallDisk(folder.to_owned())))
}

/// Until nothing fits any more.
fn fill(folder: &Path) -> Result<(), DeliveryError> {
    use std::io::Write as _;
    let mut file = std::fs::File::create(folder.join("filler")).map_err(io("fill a disk"))?;
    while file.write_all(&[0; 4_096]).is_ok() {}
    while file.write_all(&[0]).is_ok() {}
    Ok(())
}

fn table(torn: &Damage, flipped: &Damage, full: &Damage) -> Table {
    let row =
        |what: &str, cases: usize, then: String| vec![what.to_owned(), cases.to_string(), then];
    Table {
        title: "What a disk may do".to_owned(),
        header: ["damage", "cases", "outcome"].map(str::to_owned).to_vec(),
        rows: vec![
            row(
                "the last write torn, byte by byte",
                torn.cases,
                format!("{} alarms lost that were whole", torn.audit.lost),
            ),
            row(
                "a bit of the log flipped",
                flipped.cases,
                format!(
                    "{} cost alarms, {} changed alarms sent",
                    flipped.costly, flipped.audit.lost
                ),
            ),
            row(
                "disk full",
                full.cases,
                format!(
                    "{} stored, {} of them lost; the rest refused",
                    full.audit.put, full.audit.lost
                ),
            ),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_torn_write_costs_no_alarm_that_was_whole_and_a_flipped_bit_makes_none() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = Copies::new(scratch.path()).unwrap();
        let torn = torn(&folder, 401).unwrap();
        assert_eq!((torn.audit.lost, torn.cases > 20), (0, true), "{torn:?}");
        let flipped = flipped(&folder, 1_999).unwrap();
        assert_eq!(flipped.audit.lost, 0, "{flipped:?}");
    }
}
