//! Checks that every implementation of the rig's traits passes; they panic where it does not, as tests do.

use echolake_schema::Timestamp;

use crate::rig::{AmbientSensor, AudioInterface, Power, Robots, Take};

/// The arms go where they are told and refuse what they cannot reach.
///
/// # Panics
/// Where they do not.
pub fn robots(robots: &mut dyn Robots, reachable: [[f64; 3]; 2], unreachable: [[f64; 3]; 2]) {
    let [microphone, speaker] = reachable;
    assert!(robots.power(Power::On).is_ok(), "the drives switch on");
    let stand = robots.move_to(microphone, speaker).unwrap_or_else(|e| panic!("{e}"));
    for (wanted, reached) in [(microphone, stand.microphone_mm), (speaker, stand.speaker_mm)] {
        let off = wanted.iter().zip(reached).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(off < 0.5, "{off} mm off");
    }
    assert!(robots.move_to(unreachable[0], unreachable[1]).is_err(), "an unreachable position is refused");
    assert!(robots.power(Power::Off).is_ok(), "the drives switch off");
    assert!(robots.move_to(speaker, microphone).is_err(), "nothing moves without power");
    assert!(robots.power(Power::On).is_ok(), "the drives switch on again");
}

/// Takes are as long as the output, the loopback carries the output, and time goes on.
///
/// # Panics
/// Where they are not.
pub fn audio(audio: &mut dyn AudioInterface) {
    assert!(audio.rate_hz() > 0.0);
    let tone: Vec<f32> = (0..4_800).map(|n| 0.25 * (n as f32 * 0.7).sin()).collect();
    let (mut take, mut last) = (Take::default(), Timestamp(i64::MIN));
    for output in [&tone[..], &tone[..1_000], &[0.0; 2_000]] {
        audio.play_and_record(output, &mut take).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!([take.microphone.len(), take.loopback.len()], [output.len(); 2]);
        assert!(take.microphone.iter().chain(&take.loopback).all(|x| (-(1 << 23)..1 << 23).contains(x)));
        let started = take.started.unwrap_or(last);
        assert!(started > last, "takes have later and later times");
        last = started;
        let power = |x: &[i32]| x.iter().map(|x| (f64::from(*x) / 8_388_608.0).powi(2)).sum::<f64>() / x.len() as f64;
        let sent = output.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / output.len() as f64;
        match sent > 0.0 {
            true => assert!((0.01..4.0).contains(&(power(&take.loopback) / sent)), "the loopback carries the output"),
            false => assert!(power(&take.loopback) < 1e-6, "silence stays silent"),
        }
    }
}

/// Readings are finite, plausible, and in the order of time.
///
/// # Panics
/// Where they are not.
pub fn sensor(sensor: &mut dyn AmbientSensor) {
    let mut last = Timestamp(i64::MIN);
    for _ in 0..10 {
        let reading = sensor.read().unwrap_or_else(|e| panic!("{e}"));
        assert!(reading.at >= last);
        last = reading.at;
        assert!((-20.0..=60.0).contains(&reading.temperature_c), "{reading:?}");
        assert!((0.0..=100.0).contains(&reading.humidity_pct), "{reading:?}");
        assert!((300.0..=1_100.0).contains(&reading.pressure_hpa), "{reading:?}");
        assert!((0.0..=150.0).contains(&reading.outside_level_db), "{reading:?}");
    }
}
