//! REW's export of an impulse response as text: lines of prose, lines of a number and its name, and a sample a line.
//!
//! Source: the "Export impulse response as text" of REW's help, and files of versions 5.19 to 5.40.

use std::io::Read as _;
use std::path::Path;

use echolake_acquisition::disk::open_plain_file;

use super::RewResponse;

const PEAK: &str = "peak value";
const LENGTH: &str = "response length";
const INTERVAL: &str = "sample interval";
const START: &str = "start time";
/// Begins of the names of fields, in lower case. Another text with `//` in it is prose.
const FIELDS: [&str; 5] = [PEAK, "peak index", LENGTH, INTERVAL, START];

/// What is known of a file before its samples.
#[derive(Default)]
pub(super) struct RewText {
    fields: Vec<HeaderField>,
    is_normalised: bool,
    has_loopback: bool,
    /// A line says that only samples follow.
    has_begun: bool,
}

/// A number of the header.
struct HeaderField {
    name: &'static str,
    value: f64,
    line: usize,
}

impl RewText {
    /// Reads a file; the text of an error names the line and the fault.
    pub fn read(path: &Path) -> Result<RewResponse, String> {
        let mut bytes = Vec::new();
        let read = open_plain_file(path).and_then(|mut file| file.read_to_end(&mut bytes));
        read.map_err(|e| format!("cannot be read: {e}"))?;
        let mut header = Self::default();
        let mut samples = Vec::new();
        for (line, text) in (1..).zip(String::from_utf8_lossy(&bytes).lines()) {
            let text = text.trim_start_matches('\u{feff}').trim();
            match parse_number(text) {
                Some(sample) if (sample as f32).is_finite() => samples.push(sample),
                Some(_) => return Err(format!("line {line}: `{}`, expected a finite f32", shorten(text))),
                None if text.is_empty() => {}
                None if samples.is_empty() && !header.has_begun => {
                    header.read_line(text, line).map_err(|fault| format!("line {line}: {fault}"))?
                }
                None => return Err(format!("line {line}: `{}`, expected a sample", shorten(text))),
            }
        }
        header.make_response(samples)
    }

    fn read_line(&mut self, text: &str, line: usize) -> Result<(), String> {
        if let Some((value, name)) = text.split_once("//").filter(|_| !text.starts_with('*')) {
            let name = name.trim().to_lowercase();
            if let Some(name) = FIELDS.into_iter().find(|field| name.starts_with(field)) {
                return self.read_field(name, value, line);
            }
        }
        let prose = text.trim_start_matches(['*', ' ']).to_lowercase();
        let is_so = !prose.contains(" not ");
        if prose.starts_with("ir is normali") || prose.starts_with("ir is not normali") {
            self.is_normalised = is_so;
        } else if prose.starts_with("ir window") && is_so {
            return Err("its window has been applied; hint: export it without the IR window".into());
        } else if prose.starts_with("ir is") && prose.contains("min phase") && is_so {
            return Err("it is the minimum phase version, which has no arrival; hint: export the measured one".into());
        } else if prose.starts_with("excitation") {
            self.has_loopback = prose.contains("loopback");
        } else if prose.starts_with("data start") {
            self.has_begun = true;
        }
        Ok(())
    }

    fn read_field(&mut self, name: &'static str, value: &str, line: usize) -> Result<(), String> {
        let number = parse_number(value).filter(|value| value.is_finite());
        let value = number.ok_or_else(|| format!("`{}`, expected a number", shorten(value.trim())))?;
        match self.find_field(name) {
            Some(first) => Err(format!("a second {name}, expected that of line {} alone", first.line)),
            None => {
                self.fields.push(HeaderField { name, value, line });
                Ok(())
            }
        }
    }

    fn find_field(&self, name: &str) -> Option<&HeaderField> {
        self.fields.iter().find(|field| field.name == name)
    }

    fn make_response(self, mut samples: Vec<f64>) -> Result<RewResponse, String> {
        let interval = self.find_field(INTERVAL).map(|field| field.value).filter(|secs| *secs > 0.0).ok_or(
            "has no `// Sample interval (seconds)` in its header; hint: File, Export, Export impulse response as text",
        )?;
        let declared = self.find_field(LENGTH).map(|field| field.value);
        if let Some(declared) = declared.filter(|declared| *declared != samples.len() as f64) {
            return Err(format!("is cut off: its header says {declared} samples, {} are there", samples.len()));
        }
        if self.is_normalised {
            let peak = self.find_field(PEAK).filter(|peak| peak.value > 0.0);
            let peak = peak.ok_or("is normalised, and has no `// Peak value before normalisation`")?;
            samples.iter_mut().for_each(|x| *x *= peak.value);
            if samples.iter().any(|x| !(*x as f32).is_finite()) {
                let (line, value) = (peak.line, peak.value);
                return Err(format!("line {line}: a peak value of {value:e}, expected one of finite f32"));
            }
        }
        let warning = "its header names no loopback as timing reference: its arrival is where REW put it";
        let warnings = if self.has_loopback { Vec::new() } else { vec![warning.to_owned()] };
        let start_secs = self.find_field(START).map(|field| field.value);
        Ok(RewResponse { samples, rate_hz: 1.0 / interval, start_secs, warnings })
    }
}

// REW may write numbers as the computer's locale has them.
fn parse_number(text: &str) -> Option<f64> {
    text.trim().parse().or_else(|_| text.trim().replace(',', ".").parse()).ok()
}

fn shorten(text: &str) -> String {
    text.chars().take(40).collect()
}
