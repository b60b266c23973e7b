//! Lock of a folder and of a rig's devices while a run is recorded: two runs would move the same arms, and play into
//! each other's takes.
//!
//! The system releases a lock when its process ends, however it ends. Simulated devices are computed by each process
//! for itself and are not locked.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read as _, Seek as _, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

use echolake_schema::devices::{AudioParams, DeviceParams, RobotsParams, SensorParams};
use echolake_schema::{Rig, Timestamp};
use rustix::fs::OFlags;

use crate::recovery::is_partial;
use crate::run::Error;

/// Most bytes of a lock file that are shown.
const MOST_SHOWN: u64 = 200;

/// Locks of a run. They are released when it is dropped.
#[derive(Debug)]
pub struct RecordingLock {
    _locked: Vec<File>,
}

impl RecordingLock {
    /// Locks the folder of recordings, and the devices that the rig file names, on this machine.
    ///
    /// # Errors
    /// [`Error::InUse`] if another run has one of them. A folder or device that cannot be locked for another reason, as
    /// in a file system without locks, is no error.
    pub fn acquire(folder: &Path, rig: &Rig) -> Result<Self, Error> {
        let mut locked = Vec::new();
        // A folder is locked as such, so that nothing is left in it.
        if let Ok(opened) = File::open(folder) {
            match opened.try_lock() {
                Err(TryLockError::WouldBlock) => {
                    let what = format!("the folder `{}`", folder.display());
                    return Err(Error::InUse { what, holder: find_recording(folder) });
                }
                _ => locked.push(opened),
            }
        }
        for device in device_names(&rig.devices) {
            let Ok(mut opened) = open_lock_file(&lock_path(&device)) else { continue };
            match opened.try_lock() {
                Err(TryLockError::WouldBlock) => {
                    return Err(Error::InUse { what: format!("`{device}`"), holder: read_holder(&mut opened) });
                }
                _ => {
                    // It is shown to the other program, and the lock holds without it.
                    let _ = write_holder(&mut opened, folder);
                    locked.push(opened);
                }
            }
        }
        Ok(Self { _locked: locked })
    }
}

/// Names of what runs of two rig files must not use at once; none of simulated devices.
fn device_names(devices: &DeviceParams) -> Vec<String> {
    // Every kind is named, so that a new one is not forgotten.
    let audio = match &devices.audio {
        AudioParams::Simulated => Vec::new(),
        AudioParams::Alsa(params) if params.capture == params.playback => vec![format!("audio {}", params.capture)],
        AudioParams::Alsa(params) => [&params.capture, &params.playback].map(|pcm| format!("audio {pcm}")).into(),
    };
    let sensor = match &devices.sensor {
        SensorParams::Simulated => None,
        SensorParams::Serial(params) => Some(format!("sensor {}", params.path)),
    };
    let robots = match &devices.robots {
        RobotsParams::Simulated => None,
        RobotsParams::Rosbridge(params) => Some(format!("robots {}", params.url)),
    };
    audio.into_iter().chain(sensor).chain(robots).collect()
}

// The same for every user and folder of this machine.
fn lock_path(device: &str) -> PathBuf {
    let plain: String = device.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).take(60).collect();
    let digest = crc32fast::hash(device.as_bytes());
    std::env::temp_dir().join(format!("echolake-{plain}-{digest:08x}.lock"))
}

// Another user's file is only read, which is enough for a lock. Anyone may put a link or a pipe there.
fn open_lock_file(path: &Path) -> io::Result<File> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
    let mut options = OpenOptions::new();
    options.read(true).write(true).create(true).truncate(false).custom_flags(flags);
    match options.open(path) {
        Err(e) if e.kind() == io::ErrorKind::PermissionDenied => {
            OpenOptions::new().read(true).custom_flags(flags).open(path)
        }
        opened => opened,
    }
}

fn write_holder(file: &mut File, folder: &Path) -> io::Result<()> {
    file.set_len(0)?;
    file.rewind()?;
    let process = std::process::id();
    let since = Timestamp::now();
    write!(file, "process {process} records into `{}` since {since}", folder.display())
}

fn read_holder(file: &mut File) -> String {
    let mut text = Vec::new();
    let _ = file.take(MOST_SHOWN).read_to_end(&mut text);
    let text = String::from_utf8_lossy(&text);
    let shown: String = text.chars().filter(|c| !c.is_control()).collect();
    if shown.is_empty() { "another run is about to begin".to_owned() } else { shown }
}

// The recording in the folder whose recorder lives. Its name begins with the time of its begin.
fn find_recording(folder: &Path) -> String {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let files = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file())).map(|entry| entry.path());
    let is_recorded = |path: &PathBuf| {
        let opened = File::open(path);
        opened.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
    };
    let newest = files.filter(|path| is_partial(path)).filter(is_recorded).max();
    match newest.as_ref().and_then(|path| path.file_name()) {
        Some(name) => format!("`{}` is being recorded", name.to_string_lossy()),
        None => "another run is about to begin".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REAL: &str = "[devices.audio]\nkind = \"alsa\"\n[devices.sensor]\nkind = \"serial\"\npath = \"NAME/line\"\n\
        [devices.robots]\nkind = \"rosbridge\"\nurl = \"ws://NAME:9090\"\n";

    // Devices that no other test has.
    fn real_rig(name: &str, url: &str) -> Rig {
        let pcm = format!("kind = \"alsa\"\ncapture = \"{name}\"\nplayback = \"{name}-out\"");
        Rig::from_toml(&REAL.replace("kind = \"alsa\"", &pcm).replace("ws://NAME", url).replace("NAME", name))
            .expect("a rig")
    }

    #[test]
    fn a_folder_is_recorded_into_once() {
        let [one, other] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        let rig = Rig::paper();
        let lock = RecordingLock::acquire(one.path(), &rig).expect("free");
        let refused = || RecordingLock::acquire(one.path(), &rig).expect_err("in use").to_string();
        assert!(refused().contains("is in use: another run is about to begin; hint: "), "{}", refused());
        RecordingLock::acquire(other.path(), &rig).expect("simulated rigs share nothing");
        // Of two recordings that are there one lives.
        let [left, live] = ["20260105T080000Z-flat-1.mcap.partial", "20260105T090000Z-foam-2.mcap.partial"];
        let [_left, live_file] = [left, live].map(|name| File::create(one.path().join(name)).expect("a file"));
        live_file.lock().expect("locked");
        assert!(refused().contains(&format!("`{live}` is being recorded")), "{}", refused());
        drop(lock);
        RecordingLock::acquire(one.path(), &rig).expect("free again");
        assert_eq!(std::fs::read_dir(one.path()).expect("listed").count(), 2, "nothing is left");
    }

    #[test]
    fn a_device_is_used_by_one_run() {
        let folders = [(); 3].map(|()| tempfile::tempdir().expect("a folder"));
        let name = folders[0].path().file_name().expect("a name").to_string_lossy().into_owned();
        let rig = real_rig(&name, &format!("ws://{name}"));
        let lock = RecordingLock::acquire(folders[0].path(), &rig).expect("free");
        let error = RecordingLock::acquire(folders[1].path(), &rig).expect_err("in use").to_string();
        let process = format!("`audio {name}` is in use: process {} records into `", std::process::id());
        assert!(error.contains(&process) && error.contains("since 2"), "{error}");
        // Another rig file of which only the arms are the same.
        let arms = real_rig(&format!("{name}-b"), &format!("ws://{name}"));
        let error = RecordingLock::acquire(folders[1].path(), &arms).expect_err("in use").to_string();
        assert!(error.contains(&format!("`robots ws://{name}:9090` is in use")), "{error}");
        let other = real_rig(&format!("{name}-c"), &format!("ws://{name}-c"));
        RecordingLock::acquire(folders[2].path(), &other).expect("another rig");
        drop(lock);
        RecordingLock::acquire(folders[1].path(), &rig).expect("free again");
        for rig in [rig, arms, other] {
            for device in device_names(&rig.devices) {
                let _ = std::fs::remove_file(lock_path(&device));
            }
        }
    }
}
