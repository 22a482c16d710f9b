//! ONNX Runtime: where its shared library is, and the one environment of the process.

use super::ModelError;
use ort::environment::Environment;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

const LIBRARY: &str = ".x/onnxruntime/libonnxruntime.so";

/// The loaded library.
#[derive(Debug, Clone)]
pub(super) struct Runtime {
    pub environment: Environment,
    pub version: String,
}

/// The library can be loaded once in a process; this keeps it.
static LOADED: Mutex<Option<Runtime>> = Mutex::new(None);

/// The process's ONNX Runtime, loaded at the first call.
pub(super) fn runtime() -> Result<Runtime, ModelError> {
    let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(runtime) = &*loaded {
        return Ok(runtime.clone());
    }
    let path = find(&candidates())?;
    let runtime = load(&path)?;
    *loaded = Some(runtime.clone());
    Ok(runtime)
}

/// Where the library may be: `ORT_DYLIB_PATH` alone if it is set, else `.x/` beside the working
/// directory and beside each folder above the executable.
fn candidates() -> Vec<PathBuf> {
    if let Some(named) = std::env::var_os("ORT_DYLIB_PATH").filter(|path| !path.is_empty()) {
        return vec![named.into()];
    }
    let here = std::env::current_dir().into_iter();
    let program = std::env::current_exe().unwrap_or_default();
    let above = program
        .ancestors()
        .skip(1)
        .filter(|folder| !folder.as_os_str().is_empty());
    here.chain(above.map(Path::to_path_buf))
        .map(|folder| folder.join(LIBRARY))
        .collect()
}

fn find(candidates: &[PathBuf]) -> Result<PathBuf, ModelError> {
    let missing = || ModelError::RuntimeMissing {
        searched: candidates.to_vec(),
    };
    candidates
        .iter()
        .find(|path| path.is_file())
        .cloned()
        .ok_or_else(missing)
}

fn load(path: &Path) -> Result<Runtime, ModelError> {
    let unusable = |reason: String| ModelError::RuntimeUnusable {
        path: path.to_owned(),
        reason,
    };
    let environment = ort::init_from(path)
        .map_err(|error| unusable(error.to_string()))?
        .with_name("emberfix")
        .with_telemetry(false)
        .build()
        .map_err(|error| unusable(error.to_string()))?;
    Ok(Runtime {
        environment,
        version: version(path),
    })
}

/// The version in the library's real file name (`libonnxruntime.so.1.32.0`), or what it says of its
/// build when it carries none.
fn version(path: &Path) -> String {
    let real = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let name = real
        .file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    match name.split_once(".so.") {
        Some((_, version)) => version.to_owned(),
        None => ort::info().to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_library_names_every_path_and_the_remedy() {
        let searched = [
            PathBuf::from("/nowhere/a.so"),
            PathBuf::from("/nowhere/b.so"),
        ];
        let message = find(&searched).unwrap_err().to_string();
        for part in ["/nowhere/a.so", "/nowhere/b.so", "./x setup"] {
            assert!(message.contains(part), "{message}");
        }
    }
}
