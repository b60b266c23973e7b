//! Takes over a duplex with a cable, and with every fault that can happen to one.

use super::*;
use crate::rig::conformance;

const DELAY: usize = 613;

/// A duplex with its output looped back; faults are taken from the front.
pub(in crate::rig::drivers) struct LoopbackCable {
    faults: Vec<CableFault>,
    now: Timestamp,
    gain: f64,
}

#[derive(Clone, Copy)]
pub(in crate::rig::drivers) enum CableFault {
    Overrun,
    Dropped(usize),
    Unplugged,
    Short,
    None,
}

impl AudioDuplex for LoopbackCable {
    fn rate_hz(&self) -> f64 {
        96_000.0
    }

    fn transfer(
        &mut self,
        output: &[f32],
        frames: usize,
        recorded: &mut DuplexRecording,
    ) -> Result<Timestamp, TransferError> {
        self.now = self.now.plus_secs(1.0);
        let fault = if self.faults.is_empty() { CableFault::None } else { self.faults.remove(0) };
        let sample = |n: usize| n.checked_sub(DELAY).and_then(|n| output.get(n)).copied().unwrap_or(0.0);
        let loopback = (0..frames).map(|n| match fault {
            CableFault::Dropped(count) if n > frames / 2 => sample(n + count),
            _ => sample(n),
        });
        recorded.loopback = loopback.map(|x| (f64::from(x) * self.gain * 8_388_608.0) as i32).collect();
        // A microphone hears later than a cable.
        let heard = |n: usize| n.checked_sub(30).map_or(0, |n| recorded.loopback[n] / 4);
        recorded.microphone = (0..frames).map(heard).collect();
        match fault {
            CableFault::Overrun => Err(TransferError::Transient("overrun".into())),
            CableFault::Unplugged => Err(TransferError::Permanent("no such device".into())),
            CableFault::Short => {
                recorded.loopback.pop();
                Ok(self.now)
            }
            _ => Ok(self.now),
        }
    }
}

fn with(faults: &[CableFault]) -> AlignedAudio<LoopbackCable> {
    since(Timestamp(1_000), faults)
}

/// A cable whose clock begins at `now`.
pub(in crate::rig::drivers) fn since(now: Timestamp, faults: &[CableFault]) -> AlignedAudio<LoopbackCable> {
    AlignedAudio::new(LoopbackCable { faults: faults.to_vec(), now, gain: 0.9 }, 0.05, 2)
}

fn sweep() -> Vec<f32> {
    (0..9_600).map(|n| n as f32).map(|n| 0.5 * (n * (0.13 + n * 1.2e-4)).sin()).collect()
}

#[test]
fn it_conforms() {
    conformance::check_audio(&mut with(&[]));
}

#[test]
fn takes_begin_with_the_output() {
    let (mut audio, mut take, output) = (with(&[]), AudioTake::default(), sweep());
    audio.play_and_record(&output, &mut take).expect("a take");
    let first = output.iter().map(|x| (f64::from(*x) * 0.9 * 8_388_608.0) as i32).collect::<Vec<_>>();
    assert_eq!(take.loopback, first, "sample by sample");
    let expected = Timestamp(1_000).plus_secs(1.0 + DELAY as f64 / 96_000.0);
    assert_eq!(take.started, Some(expected));
}

#[test]
fn takes_with_gaps_are_repeated_and_told_of() {
    for fault in [CableFault::Overrun, CableFault::Dropped(1), CableFault::Dropped(300), CableFault::Short] {
        let (mut audio, mut take) = (with(&[fault, fault]), AudioTake::default());
        audio.play_and_record(&sweep(), &mut take).expect("the third try");
        let notices = audio.take_notices();
        assert_eq!(notices.len(), 2, "{notices:?}");
        assert!(notices.iter().all(|n| n.starts_with("take repeated: ")), "{notices:?}");
        assert!(audio.take_notices().is_empty());
    }
    let mut audio = with(&[CableFault::Dropped(1)]);
    audio.play_and_record(&sweep(), &mut AudioTake::default()).expect("the second try");
    assert_eq!(audio.take_notices(), ["take repeated: 1 samples went missing or came twice"]);
}

#[test]
fn what_does_not_pass_is_named() {
    let check = |mut audio: AlignedAudio<LoopbackCable>, expected: &str| {
        let error = audio.play_and_record(&sweep(), &mut AudioTake::default()).expect_err(expected).to_string();
        assert!(error.starts_with("audio interface: ") && error.contains(expected), "{error}");
    };
    check(with(&[CableFault::Overrun; 3]), "3 takes in a row have gaps, the last: overrun; hint");
    check(with(&[CableFault::Unplugged]), "no such device");
    let mut unplugged = with(&[]);
    unplugged.duplex.gain = 0.0;
    check(unplugged, "is its cable plugged in");
}

#[test]
fn clipping_stays_in_the_take() {
    let (mut audio, mut take) = (with(&[]), AudioTake::default());
    audio.duplex.gain = 1.0;
    let output: Vec<f32> = sweep().iter().map(|x| (4.0 * x).clamp(-1.0, 1.0)).collect();
    audio.play_and_record(&output, &mut take).expect("a take");
    assert!(take.loopback.contains(&-(1 << 23)), "the verdict is the controller's");
}
