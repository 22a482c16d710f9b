//! MAVLink signing on disk: what must outlive the process, so that nothing recorded passes twice.

use emberfix_frames::{ServiceTime, SignedDuration};
use emberfix_mav::signing::SigningCounters;
use emberfix_mav::{Guard, Judgement, RawFrame, Signer, SigningKey, SigningState};
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// How often the state is written while frames come; what is written is two seconds ahead.
const WRITE_EVERY: SignedDuration = SignedDuration::from_secs(1);

/// Why the state can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum SigningFileError {
    /// Not to be read, or not to be written.
    #[error("MAVLink signing state {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Damaged: without it, what was recorded before could pass again.
    #[error(
        "MAVLink signing state {}: {problem}; delete it only if nobody recorded the link",
        path.display()
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: serde_json::Error,
    },
}

/// A guard whose state is on disk.
#[derive(Debug)]
pub struct SigningFile {
    path: PathBuf,
    key: SigningKey,
    guard: Guard,
    kept: SigningState,
    written: ServiceTime,
    complained: bool,
}

impl SigningFile {
    /// Goes on from `path`, or begins there.
    ///
    /// # Errors
    /// [`SigningFileError`]: a state that can't be kept is refused at the start, not in flight.
    pub fn open(
        path: &Path,
        key: SigningKey,
        unsigned_ids: Vec<u32>,
        now: ServiceTime,
    ) -> Result<Self, SigningFileError> {
        let kept = read(path)?;
        let mut guard = Guard::new(key.clone(), unsigned_ids, &kept);
        guard.note_time(now);
        let mut file = Self {
            path: path.to_owned(),
            key,
            guard,
            kept,
            written: now,
            complained: false,
        };
        file.write()?;
        Ok(file)
    }

    /// Signs for one of our ends; each end of the same address has a link id of its own.
    #[must_use]
    pub fn signer(&self, link: u8, now: ServiceTime) -> Signer {
        let mut signer = Signer::new(self.key.clone(), link, &self.kept);
        signer.advance(now);
        signer
    }

    /// Whether to take a frame, and whether it is signed with our key.
    pub fn judge(&mut self, frame: &RawFrame) -> Judgement {
        let judgement = self.guard.judge(frame);
        if let Judgement::Refused(reason) = judgement
            && self.guard.counters().refused().is_power_of_two()
        {
            tracing::warn!(?reason, from = %frame.sender(), counters = ?self.guard.counters(),
                "a MAVLink frame was refused");
        }
        judgement
    }

    /// What a clock or a signed autopilot says.
    pub fn note_time(&mut self, now: ServiceTime) {
        self.guard.note_time(now);
    }

    /// What was taken and refused.
    #[must_use]
    pub fn counters(&self) -> SigningCounters {
        self.guard.counters()
    }

    /// Writes the state if it is time. Call it every second or so.
    pub fn keep(&mut self, now: ServiceTime) {
        if now - self.written < WRITE_EVERY {
            return;
        }
        self.written = now;
        match self.write() {
            Ok(()) => self.complained = false,
            Err(error) => {
                if !std::mem::replace(&mut self.complained, true) {
                    tracing::error!(%error, "after a restart, recent recordings would pass");
                }
            }
        }
    }

    /// Beside its place, synced, then moved there.
    fn write(&mut self) -> Result<(), SigningFileError> {
        let state = self.guard.state();
        let beside = self.path.with_added_extension("new");
        let write = || {
            let mut file = std::fs::File::create(&beside)?;
            file.write_all(serde_json::json!(state).to_string().as_bytes())?;
            file.sync_data()?;
            std::fs::rename(&beside, &self.path)
        };
        write().map_err(|source| SigningFileError::Io {
            path: self.path.clone(),
            source,
        })
    }
}

fn read(path: &Path) -> Result<SigningState, SigningFileError> {
    let text = match std::fs::read(path) {
        Ok(text) => text,
        Err(source) if source.kind() == std::io::ErrorKind::NotFound => {
            return Ok(SigningState::default());
        }
        Err(source) => {
            let path = path.to_owned();
            return Err(SigningFileError::Io { path, source });
        }
    };
    serde_json::from_slice(&text).map_err(|problem| SigningFileError::Damaged {
        path: path.to_owned(),
        problem,
    })
}
