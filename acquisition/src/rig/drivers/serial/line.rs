//! One line of the ambient sensor: `T=21.53 RH=45.2 P=965.1 L=42.0`, with `*hh` behind it if the sensor sends a
//! checksum.

/// Values of one line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorLine {
    /// Temperature, C.
    pub temperature_c: f64,
    /// Relative humidity, %.
    pub humidity_pct: f64,
    /// Pressure, hPa.
    pub pressure_hpa: f64,
    /// Sound pressure level outside, dB re 20 uPa.
    pub level_db: f64,
}

/// The four values: name, least, greatest. Beyond them the sensor is broken, not the weather.
const VALUES: [(&str, f64, f64); 4] =
    [("T", -40.0, 85.0), ("RH", 0.0, 100.0), ("P", 300.0, 1_100.0), ("L", 0.0, 150.0)];

impl SensorLine {
    /// Reads a line without its end. None if it is empty or a comment, which begins with `#`.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(text: &str) -> Result<Option<Self>, String> {
        let text = text.trim();
        if text.is_empty() || text.starts_with('#') {
            return Ok(None);
        }
        let text = without_sum(text)?;
        let mut found = [None; 4];
        for word in text.split([' ', ',', ';', '\t']).filter(|w| !w.is_empty()) {
            let (name, value) = word.split_once('=').ok_or_else(|| format!("`{word}` is no `name=value`"))?;
            // Sensors may tell more than is asked of them.
            let Some(i) = VALUES.iter().position(|(known, ..)| *known == name) else { continue };
            let (_, least, greatest) = VALUES[i];
            let number = value.parse().ok().filter(|x: &f64| (least..=greatest).contains(x));
            let number = number.ok_or_else(|| format!("{name} is `{value}`, expected {least} to {greatest}"))?;
            if found[i].replace(number).is_some() {
                return Err(format!("{name} is there twice"));
            }
        }
        match found {
            [Some(temperature_c), Some(humidity_pct), Some(pressure_hpa), Some(level_db)] => {
                Ok(Some(Self { temperature_c, humidity_pct, pressure_hpa, level_db }))
            }
            _ => {
                let missing = VALUES.iter().zip(found).find(|(_, value)| value.is_none());
                Err(format!("{} is missing", missing.map_or("a value", |((name, ..), _)| name)))
            }
        }
    }
}

// As in NMEA 0183: behind `*`, the exclusive or of all bytes before it, two hexadecimal digits.
fn without_sum(text: &str) -> Result<&str, String> {
    let Some((content, sum)) = text.rsplit_once('*') else { return Ok(text) };
    let expected = content.bytes().fold(0, |sum, byte| sum ^ byte);
    match u8::from_str_radix(sum, 16) {
        Ok(sum) if sum == expected => Ok(content),
        _ => Err(format!("its sum is `{sum}`, expected {expected:02X}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_read() {
        let line = SensorLine { temperature_c: 21.53, humidity_pct: 45.2, pressure_hpa: 965.1, level_db: 42.0 };
        for text in [
            "T=21.53 RH=45.2 P=965.1 L=42.0",
            "L=42,RH=45.2,P=965.1,T=21.53,CO2=412\r",
            "T=21.53 RH=45.2 P=965.1 L=42.0*47",
        ] {
            let sum = text.split('*').next().unwrap_or_default().bytes().fold(0, |sum, byte| sum ^ byte);
            let text =
                if text.contains('*') { format!("T=21.53 RH=45.2 P=965.1 L=42.0*{sum:02x}") } else { text.into() };
            assert_eq!(SensorLine::parse(&text), Ok(Some(line)), "{text}");
        }
        for text in ["", "  \r", "# booting, firmware 1.2"] {
            assert_eq!(SensorLine::parse(text), Ok(None), "{text:?}");
        }
    }

    #[test]
    fn nonsense_is_named() {
        let check = |text: &str, expected: &str| {
            let error = SensorLine::parse(text).expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        };
        check("hello", "no `name=value`");
        check("T=21 RH=45 P=965", "L is missing");
        check("T=nan RH=45 P=965 L=40", "T is `nan`, expected -40 to 85");
        check("T=21 RH=145 P=965 L=40", "RH is `145`");
        check("T=21 T=22 RH=45 P=965 L=40", "twice");
        check("T=21 RH=45 P=965 L=40*00", "its sum is `00`");
        check("\u{fffd}\u{fffd}T", "no `name=value`");
    }

    #[test]
    fn random_bytes_never_pass_as_a_reading() {
        let mut x = 7u64;
        for _ in 0..20_000 {
            let bytes: Vec<u8> = (0..24)
                .map(|_| {
                    x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    (x >> 56) as u8
                })
                .collect();
            assert!(!matches!(SensorLine::parse(&String::from_utf8_lossy(&bytes)), Ok(Some(_))));
        }
    }
}
