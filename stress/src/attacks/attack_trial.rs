//! One attack: other clients query meanwhile, memory is sampled, and afterwards the server must be idle.

use std::time::{Duration, Instant};

use super::super::observed_server::{LightLoad, MemoryWatch, ObservedServer, QueryClient};
use super::attack_report::{AttackRow, ServerFate};
use super::{AttackCase, HOSTILE_MEMORY_MB};

/// Other clients query for so long at least, even if an attack ends at once.
const SHORTEST_TRIAL: Duration = Duration::from_secs(1);
/// From the end of an attack until the server must be idle.
const SETTLE_TIME: Duration = Duration::from_millis(500);
/// Over which its processor time is measured then.
const IDLE_TIME: Duration = Duration::from_secs(1);
/// A server that still works so long after an attack is replaced, so that the next one meets an idle one.
const IDLE_LIMIT: Duration = Duration::from_secs(20);

/// A trial of an attack.
pub(super) struct AttackTrial<'a> {
    server: &'a mut ObservedServer,
    attacker: QueryClient,
}

impl<'a> AttackTrial<'a> {
    /// `number` says which of the hostile clients attacks.
    pub fn new(server: &'a mut ObservedServer, number: usize) -> Self {
        let attacker = server.client("hostile", number);
        Self { server, attacker }
    }

    pub fn run(mut self, case: &AttackCase, seconds: f64) -> AttackRow {
        let idle_mib = self.server.process_tree().memory().total_kib >> 10;
        let watch = MemoryWatch::start(self.server.process_tree());
        let ends_before = self.server.count_engine_ends();
        let light = LightLoad::start(self.server);
        let begun = Instant::now();
        let connections = &self.attacker.connections;
        let outcomes = connections.close_after(Duration::from_secs_f64(seconds), || case.run(&self.attacker));
        connections.close_all();
        let took = begun.elapsed();
        std::thread::sleep(SHORTEST_TRIAL.saturating_sub(took));
        light.pause();
        std::thread::sleep(SETTLE_TIME);
        let idle_time = self.server.process_tree().processor_time_over(IDLE_TIME);
        let light = light.stop();
        let fate = self.find_fate(&watch);
        let peak = watch.peak();
        let engine_ends = self.server.count_engine_ends() - ends_before;
        drop(watch);
        if fate != ServerFate::Alive {
            self.server.restart();
        }
        AttackRow {
            name: case.name(),
            protocol: case.protocol(),
            outcomes,
            took,
            light,
            engine_ends,
            peak,
            idle_mib,
            limit_mib: (HOSTILE_MEMORY_MB * 1_000_000) >> 20,
            idle_time,
            fate,
        }
    }

    // An attack may have effects after its end, and kill the server then: it is watched until it is idle.
    fn find_fate(&mut self, watch: &MemoryWatch) -> ServerFate {
        let is_idle = self.server.wait_until_idle(IDLE_LIMIT);
        match self.server.is_alive() {
            _ if watch.peak().is_capped => ServerFate::Capped,
            false => ServerFate::Died(self.server.last_words()),
            true if is_idle => ServerFate::Alive,
            true => ServerFate::Busy,
        }
    }
}
