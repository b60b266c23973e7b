//! The list of attacks: each statement over each protocol that takes SQL, and each attack on a protocol itself.

use super::super::observed_server::{QueryClient, QueryProtocol};
use super::sql::{SQL_FAMILIES, SqlAttack};
use super::wire::{UPLOADS, UploadAttack, WIRE_FAMILIES, WireAttack, WirePort};

/// Connections that send a hostile statement at once; more than processors here, as many as a client may open.
const SQL_CONNECTIONS: usize = 4;
/// Attacks of each family in a short selection.
const QUICK_ATTACKS: usize = 2;

/// An attack over one protocol.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AttackCase {
    family: &'static str,
    kind: AttackKind,
}

#[derive(Debug, Clone, Copy)]
enum AttackKind {
    Sql(&'static SqlAttack, QueryProtocol),
    Wire(WirePort, &'static WireAttack),
    Upload(&'static UploadAttack),
}

impl AttackCase {
    fn new(family: &'static str, kind: AttackKind) -> Self {
        Self { family, kind }
    }

    pub fn name(&self) -> &'static str {
        match self.kind {
            AttackKind::Sql(attack, _) => attack.name,
            AttackKind::Wire(_, attack) => attack.name,
            AttackKind::Upload(attack) => attack.name,
        }
    }

    pub fn protocol(&self) -> &'static str {
        match self.kind {
            AttackKind::Sql(_, protocol) => protocol.name(),
            AttackKind::Wire(port, _) => port.name(),
            AttackKind::Upload(_) => "flight-sql",
        }
    }

    /// Returns what `--only` looks at.
    pub fn title(&self) -> String {
        format!("{} {}", self.name(), self.protocol())
    }

    /// Attacks until the end, or until the client's connections are closed; returns how each connection ended.
    pub fn run(&self, client: &QueryClient) -> Vec<String> {
        match self.kind {
            AttackKind::Sql(attack, protocol) => ask_at_once(client, protocol, &(attack.text)()),
            AttackKind::Wire(port, attack) => attack.run(port, client),
            AttackKind::Upload(attack) => attack.run(client),
        }
    }
}

fn ask_at_once(client: &QueryClient, protocol: QueryProtocol, sql: &str) -> Vec<String> {
    std::thread::scope(|scope| {
        let ask = || client.query(protocol, sql).to_string();
        let connections: Vec<_> = (0..SQL_CONNECTIONS).map(|_| scope.spawn(ask)).collect();
        connections.into_iter().map(|c| c.join().unwrap_or_else(|_| "panicked".to_owned())).collect()
    })
}

/// Returns every attack over every protocol.
pub(crate) fn all_cases() -> Vec<AttackCase> {
    let mut cases = Vec::new();
    for (family, attacks) in SQL_FAMILIES {
        for attack in attacks {
            let over = |protocol| AttackCase::new(family, AttackKind::Sql(attack, protocol));
            cases.extend(QueryProtocol::ALL.map(over));
        }
    }
    cases.extend(wire_cases());
    cases
}

/// Returns the first attacks of each family, over one protocol each.
pub(crate) fn quick_cases() -> Vec<AttackCase> {
    let mut cases = Vec::new();
    for (number, (family, attacks)) in SQL_FAMILIES.into_iter().enumerate() {
        for (place, attack) in attacks.iter().take(QUICK_ATTACKS).enumerate() {
            let turn = number * QUICK_ATTACKS + place;
            let protocol = QueryProtocol::ALL[turn % QueryProtocol::ALL.len()];
            cases.push(AttackCase::new(family, AttackKind::Sql(attack, protocol)));
        }
    }
    let mut taken: Vec<AttackCase> = Vec::new();
    for case in wire_cases() {
        if taken.iter().filter(|other| other.family == case.family).count() < QUICK_ATTACKS {
            taken.push(case);
        }
    }
    cases.extend(taken);
    cases
}

fn wire_cases() -> Vec<AttackCase> {
    let mut cases = Vec::new();
    for (port, attacks) in WIRE_FAMILIES {
        cases.extend(attacks.iter().map(|attack| AttackCase::new(port.name(), AttackKind::Wire(port, attack))));
    }
    cases.extend(UPLOADS.iter().map(|attack| AttackCase::new("uploads", AttackKind::Upload(attack))));
    cases
}
