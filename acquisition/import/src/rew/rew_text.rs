//! REW's export of an impulse response as text: lines of prose, lines of a number and its name, and a sample a line.
//!
//! Source: the "Export impulse response as text" of REW's help, and files of versions 5.19 to 5.40.

use std::path::Path;

use super::RewResponse;

/// What is known of a file before its samples.
#[derive(Default)]
pub(super) struct RewText {
    fields: Vec<(String, f64)>,
    is_normalised: bool,
    has_loopback: bool,
}

impl RewText {
    /// Reads a file; the text of an error names the line and the fault.
    pub fn read(path: &Path) -> Result<RewResponse, String> {
        let bytes = std::fs::read(path).map_err(|e| format!("cannot be read: {e}"))?;
        let mut header = Self::default();
        let mut samples = Vec::new();
        for (line, text) in (1..).zip(String::from_utf8_lossy(&bytes).lines()) {
            let text = text.trim_start_matches('\u{feff}').trim();
            match parse_number(text) {
                Some(sample) => samples.push(sample),
                None if text.is_empty() => {}
                None if samples.is_empty() => {
                    header.read_line(text).map_err(|fault| format!("line {line}: {fault}"))?
                }
                None => return Err(format!("line {line}: `{}`, expected a sample", shorten(text))),
            }
        }
        header.make_response(samples)
    }

    fn read_line(&mut self, text: &str) -> Result<(), String> {
        if let Some((value, name)) = text.split_once("//") {
            let value = parse_number(value).ok_or_else(|| format!("`{}`, expected a number", shorten(text)))?;
            self.fields.push((name.trim().to_lowercase(), value));
            return Ok(());
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
        }
        Ok(())
    }

    fn find_field(&self, name: &str) -> Option<f64> {
        self.fields.iter().find(|(field, _)| field.starts_with(name)).map(|(_, value)| *value)
    }

    fn make_response(self, mut samples: Vec<f64>) -> Result<RewResponse, String> {
        let interval = self.find_field("sample interval").filter(|secs| *secs > 0.0).ok_or(
            "has no `// Sample interval (seconds)` in its header; hint: File, Export, Export impulse response as text",
        )?;
        let declared = self.find_field("response length");
        if let Some(declared) = declared.filter(|declared| *declared != samples.len() as f64) {
            return Err(format!("is cut off: its header says {declared} samples, {} are there", samples.len()));
        }
        if self.is_normalised {
            let peak = self.find_field("peak value").filter(|peak| *peak > 0.0);
            let peak = peak.ok_or("is normalised, and has no `// Peak value before normalisation`")?;
            samples.iter_mut().for_each(|x| *x *= peak);
        }
        let warning = "its header names no loopback as timing reference: its arrival is where REW put it";
        let warnings = if self.has_loopback { Vec::new() } else { vec![warning.to_owned()] };
        let start_secs = self.find_field("start time");
        Ok(RewResponse { samples, rate_hz: 1.0 / interval, start_secs, warnings })
    }
}

// REW may write numbers as the computer's locale has them.
fn parse_number(text: &str) -> Option<f64> {
    let number = text.trim().parse().or_else(|_| text.trim().replace(',', ".").parse());
    number.ok().filter(|x: &f64| x.is_finite())
}

fn shorten(text: &str) -> String {
    text.chars().take(40).collect()
}
