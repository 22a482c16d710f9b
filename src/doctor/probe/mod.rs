//! Looks at the world and says what was seen; judges nothing.

pub mod autopilot;
pub mod camera;
pub mod computer;
pub mod ground;
pub mod mission;
pub mod model;

use super::Options;
use crate::mission::Mission;
use std::sync::mpsc::sync_channel;
use std::time::Duration;

/// What a probe may take beyond the time that it was given: ports that close slowly, a decoder.
const GRACE: Duration = Duration::from_secs(8);

/// Camera and autopilot at the same time, as in flight. A probe that does not come back is left
/// behind; what it would have seen counts as nothing, and says so.
#[must_use]
pub fn listen(
    mission: &Mission,
    options: &Options,
) -> (camera::CameraSeen, autopilot::AutopilotSeen) {
    let (listen, patience) = (options.listen, options.patience);
    let limit = listen + patience + GRACE;
    let (for_camera, for_autopilot) = (mission.clone(), mission.clone());
    let looking = start(move || camera::look(&for_camera, listen, patience));
    let hearing = start(move || autopilot::hear(&for_autopilot, listen, patience));
    let camera = looking.wait(limit);
    let autopilot = hearing.wait(GRACE);
    (
        camera.unwrap_or_else(camera::CameraSeen::hanging),
        autopilot.unwrap_or_else(autopilot::AutopilotSeen::hanging),
    )
}

/// Work on a thread of its own.
struct Started<T>(std::sync::mpsc::Receiver<T>);

fn start<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Started<T> {
    let (sender, receiver) = sync_channel(1);
    // When there is no thread to be had the sender is dropped, and the wait ends at once.
    let _handle = std::thread::Builder::new()
        .name("doctor".to_owned())
        .spawn(move || sender.send(work()));
    Started(receiver)
}

impl<T> Started<T> {
    fn wait(self, limit: Duration) -> Option<T> {
        self.0.recv_timeout(limit).ok()
    }
}
