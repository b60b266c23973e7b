//! The sensor over a pair of pseudo terminals, one end of which the test holds.

use std::os::fd::AsRawFd as _;
use std::os::unix::fs::symlink;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use tempfile::TempDir;

use super::*;
use crate::rig::conformance;

/// Timeout for lines that come: a busy machine needs some of it.
pub(in crate::rig::drivers) const PATIENT_SECS: f64 = 60.0;
/// Timeout for lines that never come, as these tests want it.
pub(in crate::rig::drivers) const IMPATIENT_SECS: f64 = 1.0;
pub(in crate::rig::drivers) const GOOD: &str = "T=21.50 RH=45.0 P=965.0 L=42.0\n";

/// The sensor's end: sends a text again and again until it is dropped, which unplugs it.
pub(in crate::rig::drivers) struct FakeSensor {
    /// A link to its terminal, whose number the system soon gives to others.
    link: PathBuf,
    _folder: TempDir,
    text: Arc<Mutex<&'static str>>,
    /// Number of times that the text was sent.
    count: Arc<AtomicUsize>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl FakeSensor {
    pub fn sending(text: &'static str) -> Self {
        let (ours, theirs) = SerialPort::pair().expect("a pair of pseudo terminals");
        let folder = tempfile::tempdir().expect("a folder");
        let link = folder.path().join("sensor");
        symlink(path_of(&theirs), &link).expect("linked");
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let text = Arc::new(Mutex::new(text));
        let sent = text.clone();
        let count = Arc::new(AtomicUsize::new(0));
        let counted = count.clone();
        let thread = std::thread::spawn(move || {
            // The other end stays open, or the pair is gone before the driver opens it.
            let _held = theirs;
            while !stopped.load(Ordering::Relaxed) {
                let text = *sent.lock().expect("a text");
                let _ = ours.write_all(text.as_bytes());
                counted.fetch_add(1, Ordering::SeqCst);
                std::thread::sleep(Duration::from_millis(50));
            }
        });
        Self { link, _folder: folder, text, count, stop, thread: Some(thread) }
    }

    pub fn params(&self, timeout_secs: f64) -> SerialParams {
        SerialParams { path: self.link.display().to_string(), timeout_secs, ..SerialParams::default() }
    }

    /// Waits until its text was sent twice from now on, and is whole in the line; then it is silent.
    fn fill_line(&self) {
        let wanted = self.count.load(Ordering::SeqCst) + 3;
        self.wait_for_count(wanted);
        self.send("");
        // What is being sent is sent to its end.
        self.wait_for_count(self.count.load(Ordering::SeqCst) + 2);
    }

    fn wait_for_count(&self, wanted: usize) {
        let end = Instant::now() + Duration::from_secs_f64(PATIENT_SECS);
        while self.count.load(Ordering::SeqCst) < wanted {
            assert!(Instant::now() < end, "the fake sensor stopped sending");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Something else from now on.
    pub fn send(&self, text: &'static str) {
        *self.text.lock().expect("a text") = text;
    }

    /// Its end of the line is gone.
    pub fn unplug(&mut self) {
        let _ = std::fs::remove_file(&self.link);
        self.stop.store(true, Ordering::Relaxed);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

impl Drop for FakeSensor {
    fn drop(&mut self) {
        self.unplug();
    }
}

fn path_of(port: &SerialPort) -> PathBuf {
    std::fs::read_link(format!("/proc/self/fd/{}", port.as_raw_fd())).expect("a terminal")
}

fn message(sensor: &mut SerialSensor) -> String {
    sensor.read_ambient().expect_err("no reading").to_string()
}

#[test]
fn it_conforms() {
    let fake = FakeSensor::sending(GOOD);
    let mut sensor = SerialSensor::open(&fake.params(PATIENT_SECS)).expect("open");
    conformance::check_sensor(&mut sensor);
    assert_eq!(sensor.read_ambient().expect("a reading").temperature_c, 21.5);
}

#[test]
fn the_loudest_since_the_last_reading_counts() {
    let fake = FakeSensor::sending("T=20 RH=45 P=965 L=42\nT=20 RH=45 P=965 L=71\nT=21 RH=45 P=965 L=40\n");
    let mut sensor = SerialSensor::open(&fake.params(PATIENT_SECS)).expect("open");
    sensor.read_ambient().expect("a reading");
    fake.fill_line();
    let reading = sensor.read_ambient().expect("a reading");
    assert_eq!((reading.temperature_c, reading.outside_level_db), (21.0, 71.0));
}

#[test]
fn nonsense_between_good_lines_is_told_of() {
    let fake = FakeSensor::sending("T=21.5 RH=45 P=965 L=42\n\u{1}?garbage\nT=999 RH=45 P=965 L=42\n");
    let mut sensor = SerialSensor::open(&fake.params(PATIENT_SECS)).expect("open");
    fake.fill_line();
    assert_eq!(sensor.read_ambient().expect("a reading").temperature_c, 21.5);
    let notices = sensor.take_notices().join("\n");
    assert!(notices.contains("lines of nonsense") && notices.contains("expected -40 to 85"), "{notices}");
    assert!(sensor.take_notices().is_empty(), "told once");
}

#[test]
fn a_sensor_that_is_not_there_is_named() {
    let params = SerialParams { path: "/dev/no-such-line".into(), ..SerialParams::default() };
    let error = SerialSensor::open(&params).err().expect("no such line").to_string();
    assert!(error.contains("cannot open `/dev/no-such-line`") && error.contains("hint"), "{error}");
}

mod slow {
    use super::*;

    #[test]
    fn nothing_but_nonsense_is_an_error() {
        let fake = FakeSensor::sending("\u{3}\u{7f}~~\n");
        let mut sensor = SerialSensor::open(&fake.params(IMPATIENT_SECS)).expect("open");
        fake.fill_line();
        let error = message(&mut sensor);
        assert!(error.contains("nothing but nonsense") && error.contains("is 115200 baud right?"), "{error}");
    }

    #[test]
    fn an_unplugged_sensor_is_named_and_found_again() {
        let mut first = FakeSensor::sending(GOOD);
        let mut sensor = SerialSensor::open(&first.params(PATIENT_SECS)).expect("open");
        sensor.read_ambient().expect("a reading");
        sensor.params.timeout_secs = IMPATIENT_SECS;
        first.unplug();
        // What the line still held may be read once more.
        let error = (0..3).find_map(|_| sensor.read_ambient().err()).expect("unplugged").to_string();
        assert!(error.contains("lost `") && error.contains("still plugged in"), "{error}");
        let second = FakeSensor::sending(GOOD);
        symlink(&second.link, &first.link).expect("linked");
        sensor.params.timeout_secs = PATIENT_SECS;
        sensor.read_ambient().expect("found again");
        let notices = sensor.take_notices().join("\n");
        assert!(notices.contains("lost `") && notices.contains("is open again"), "{notices}");
    }

    #[test]
    fn a_silent_sensor_is_named() {
        let fake = FakeSensor::sending("");
        let error = message(&mut SerialSensor::open(&fake.params(IMPATIENT_SECS)).expect("open"));
        assert!(error.contains("ambient sensor: no line on") && error.contains("powered"), "{error}");
    }
}
