//! The ambient sensor on a serial line. It sends lines by itself; [`mod@line`] has their format.

pub mod line;
#[cfg(test)]
pub(super) mod tests;

use std::time::{Duration, Instant};

use echolake_schema::devices::SerialParams;
use echolake_schema::{ErrorCause, Timestamp};
use serial2::SerialPort;

use crate::rig::{AmbientReading, AmbientSensor, DeviceFault, Error};
use line::SensorLine;

const DEVICE: &str = "ambient sensor";
/// Timeout of one wait for bytes; bytes without a pause of this length are taken together.
const PAUSE: Duration = Duration::from_millis(30);
/// Interval between two tries to open a lost line.
const RETRY: Duration = Duration::from_millis(100);
/// Most bytes of a line, end excluded.
const LONGEST_LINE: usize = 1024;

/// A sensor on a serial line.
pub struct SerialSensor {
    params: SerialParams,
    port: Option<SerialPort>,
    /// Bytes since the last end of a line.
    bytes: Vec<u8>,
    /// True after the first end of a line since the line was opened: the text before it was cut off.
    in_step: bool,
    last: Timestamp,
    notices: Vec<String>,
}

/// Lines received while waiting for one reading.
#[derive(Default)]
struct ReceivedLines {
    line: Option<SensorLine>,
    loudest_db: f64,
    nonsense: usize,
    last_nonsense: String,
}

impl SerialSensor {
    /// Opens the line.
    ///
    /// # Errors
    /// [`Error::Device`] if that fails.
    pub fn open(params: &SerialParams) -> Result<Self, Error> {
        let mut sensor = Self {
            params: params.clone(),
            port: None,
            bytes: Vec::new(),
            in_step: false,
            last: Timestamp(i64::MIN),
            notices: Vec::new(),
        };
        sensor.connect().map_err(|reason| Error::Device { device: DEVICE, reason })?;
        Ok(sensor)
    }

    fn connect(&mut self) -> Result<(), DeviceFault> {
        let path = &self.params.path;
        let opened = SerialPort::open(path, self.params.baud).and_then(|mut port| {
            port.set_read_timeout(PAUSE)?;
            Ok(port)
        });
        self.port = Some(opened.map_err(|e| {
            let hint = "is the sensor plugged in, and may this user open it?";
            DeviceFault::with_cause(format!("cannot open `{path}`: {e}; hint: {hint}"), e)
        })?);
        self.bytes.clear();
        self.in_step = false;
        Ok(())
    }

    // Reads the bytes that are there already, or come until a pause. An error means that the line is gone.
    fn take(&mut self, taken: &mut ReceivedLines) -> std::io::Result<()> {
        let mut buffer = [0; 512];
        loop {
            let Some(port) = &self.port else { return Ok(()) };
            match port.read(&mut buffer) {
                Ok(0) => return Err(std::io::ErrorKind::UnexpectedEof.into()),
                Ok(count) => self.split(&buffer[..count], taken),
                Err(e) if e.kind() == std::io::ErrorKind::TimedOut => return Ok(()),
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                Err(e) => return Err(e),
            }
        }
    }

    fn split(&mut self, bytes: &[u8], taken: &mut ReceivedLines) {
        for byte in bytes {
            match byte {
                b'\n' => {
                    if self.in_step {
                        taken.line(&String::from_utf8_lossy(&self.bytes));
                    }
                    self.bytes.clear();
                    self.in_step = true;
                }
                byte if self.bytes.len() < LONGEST_LINE => self.bytes.push(*byte),
                // At the wrong speed there may never be an end.
                _ => {
                    taken.nonsense(&String::from_utf8_lossy(&self.bytes), "it has no end");
                    self.bytes.clear();
                }
            }
        }
    }

    fn silent(&self, taken: &ReceivedLines, lost: Option<ErrorCause>) -> Error {
        let secs = self.params.timeout_secs;
        let path = &self.params.path;
        let reason = match (lost, taken.nonsense) {
            (Some(lost), _) => {
                let text = format!("lost `{path}`: {lost}; hint: is the sensor still plugged in?");
                DeviceFault::with_cause(text, lost)
            }
            (None, 0) => format!("no line on `{path}` for {secs} s; hint: is the sensor powered?").into(),
            (None, count) => format!(
                "nothing but nonsense on `{path}` for {secs} s, {count} lines, the last {}; hint: is {} baud right?",
                taken.last_nonsense, self.params.baud
            )
            .into(),
        };
        Error::Device { device: DEVICE, reason }
    }
}

impl ReceivedLines {
    fn line(&mut self, text: &str) {
        match SensorLine::parse(text) {
            Ok(Some(line)) => {
                self.loudest_db = self.loudest_db.max(line.level_db);
                self.line = Some(line);
            }
            Ok(None) => {}
            Err(why) => self.nonsense(text, &why),
        }
    }

    fn nonsense(&mut self, text: &str, why: &str) {
        self.nonsense += 1;
        let text: String = text.chars().take(40).collect();
        self.last_nonsense = format!("{text:?}: {why}");
    }
}

impl AmbientSensor for SerialSensor {
    fn read_ambient(&mut self) -> Result<AmbientReading, Error> {
        let end = Instant::now() + Duration::from_secs_f64(self.params.timeout_secs);
        let (mut taken, mut lost) = (ReceivedLines::default(), None::<ErrorCause>);
        loop {
            if self.port.is_none() {
                match self.connect() {
                    Ok(()) => self.notices.push(format!("`{}` is open again", self.params.path)),
                    Err(fault) => lost = Some(fault.into()),
                }
            }
            if let Err(e) = self.take(&mut taken) {
                self.notices.push(format!("lost `{}`: {e}", self.params.path));
                lost = Some(e.into());
                self.port = None;
            }
            if let Some(line) = taken.line {
                if taken.nonsense > 0 {
                    let (count, last) = (taken.nonsense, &taken.last_nonsense);
                    self.notices.push(format!("{count} lines of nonsense, the last {last}"));
                }
                self.last = Timestamp(Timestamp::now().0.max(self.last.0));
                return Ok(AmbientReading {
                    at: self.last,
                    temperature_c: line.temperature_c,
                    humidity_pct: line.humidity_pct,
                    pressure_hpa: line.pressure_hpa,
                    outside_level_db: taken.loudest_db,
                });
            }
            if Instant::now() >= end {
                return Err(self.silent(&taken, lost.filter(|_| self.port.is_none())));
            }
            if self.port.is_none() {
                std::thread::sleep(RETRY);
            }
        }
    }

    fn take_notices(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notices)
    }
}
