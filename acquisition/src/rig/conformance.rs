//! Checks that every implementation of the rig's traits passes; they panic on a failure, as tests do.

use echolake_schema::Timestamp;

use crate::rig::{AmbientSensor, AudioInterface, AudioTake, DrivePower, RobotArms};

/// Checks that the arms reach their targets and refuse positions out of reach.
///
/// # Panics
/// If they do not.
pub fn check_robots(robots: &mut dyn RobotArms, reachable: [[f64; 3]; 2], unreachable: [[f64; 3]; 2]) {
    let [microphone, speaker] = reachable;
    assert!(robots.switch_drives(DrivePower::On).is_ok(), "the drives switch on");
    let stand = robots.move_to(microphone, speaker).unwrap_or_else(|e| panic!("{e}"));
    for (wanted, reached) in [(microphone, stand.microphone_mm), (speaker, stand.speaker_mm)] {
        let off = wanted.iter().zip(reached).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(off < 0.5, "{off} mm off");
    }
    assert!(robots.move_to(unreachable[0], unreachable[1]).is_err(), "an unreachable position is refused");
    for bad in [f64::NAN, f64::INFINITY] {
        assert!(robots.move_to([bad, microphone[1], microphone[2]], speaker).is_err(), "{bad} is no position");
    }
    assert!(robots.switch_drives(DrivePower::Off).is_ok(), "the drives switch off");
    assert!(robots.move_to(speaker, microphone).is_err(), "nothing moves without power");
    assert!(robots.switch_drives(DrivePower::On).is_ok(), "the drives switch on again");
}

/// Checks that takes are as long as the output, that the loopback carries the output, and that time advances.
///
/// # Panics
/// If a check fails.
pub fn check_audio(audio: &mut dyn AudioInterface) {
    assert!(audio.rate_hz() > 0.0);
    // Its frequency rises, so that it resembles itself at one delay only.
    let tone: Vec<f32> = (0..4_800).map(|n| n as f32).map(|n| 0.25 * (n * (0.2 + n * 1e-4)).sin()).collect();
    let mut take = AudioTake::default();
    let mut last = Timestamp(i64::MIN);
    for output in [&tone[..], &tone[..1_000], &[0.0; 2_000]] {
        audio.play_and_record(output, &mut take).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!([take.microphone.len(), take.loopback.len()], [output.len(); 2]);
        assert!(take.microphone.iter().chain(&take.loopback).all(|x| (-(1 << 23)..1 << 23).contains(x)));
        let started = take.started.unwrap_or(last);
        assert!(started > last, "takes have later and later times");
        last = started;
        let power = |x: &[i32]| x.iter().map(|x| (f64::from(*x) / 8_388_608.0).powi(2)).sum::<f64>() / x.len() as f64;
        let sent = output.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / output.len() as f64;
        if sent > 0.0 {
            assert!((0.01..4.0).contains(&(power(&take.loopback) / sent)), "the loopback has the output's level");
            let likeness = highest_correlation(output, &take.loopback);
            assert!(likeness > 0.8, "the loopback carries the output: correlation {likeness}");
        } else {
            assert!(power(&take.loopback) < 1e-6, "silence stays silent");
            assert!(take.microphone.iter().all(|x| x.abs() < (1 << 23) - 1), "silence does not reach full scale");
        }
    }
}

// Highest normalised correlation at any delay up to a quarter of the output: converters take their time.
fn highest_correlation(output: &[f32], loopback: &[i32]) -> f64 {
    let norm = |x: &mut dyn Iterator<Item = f64>| x.map(|x| x * x).sum::<f64>().sqrt();
    let whole = norm(&mut output.iter().map(|x| f64::from(*x))) * norm(&mut loopback.iter().map(|x| f64::from(*x)));
    let at = |delay: usize| output.iter().zip(&loopback[delay..]).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum();
    (0..output.len() / 4).map(at).fold(0.0, f64::max) / whole
}

/// Checks that readings are finite, plausible, and in the order of time.
///
/// # Panics
/// If a check fails.
pub fn check_sensor(sensor: &mut dyn AmbientSensor) {
    let mut last = Timestamp(i64::MIN);
    for _ in 0..10 {
        let reading = sensor.read_ambient().unwrap_or_else(|e| panic!("{e}"));
        assert!(reading.at >= last);
        last = reading.at;
        assert!((-20.0..=60.0).contains(&reading.temperature_c), "{reading:?}");
        assert!((0.0..=100.0).contains(&reading.humidity_pct), "{reading:?}");
        assert!((300.0..=1_100.0).contains(&reading.pressure_hpa), "{reading:?}");
        assert!((0.0..=150.0).contains(&reading.outside_level_db), "{reading:?}");
    }
}
