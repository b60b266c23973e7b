//! Queries made of pieces of good ones.

use rand::Rng as _;
use rand::seq::IndexedRandom as _;
use rand_chacha::ChaCha8Rng;

/// Queries that are right.
const GOOD: [&str; 16] = [
    "select surface_id, count(*) from measurements group by surface_id having count(*) > 1 order by 2 desc limit 3",
    "select ir from measurements where surface_id = 'flat' and pair_id = 7",
    "select pair_id, d4(pair_id, 3), symmetry from augmented where surface_id = 'flat' limit 10",
    "select t.tnce_total, p.incidence_deg from tnce t join pairs p on p.pair_id = t.pair_id where p.direct_mm < 200",
    "with a as (select pair_id, unnest(ir) x from measurements) select pair_id, sum(x * x) from a group by pair_id",
    "select p90_mean(db(tnce_total)) over (partition by microphone order by pair_id) from tnce",
    "select band_energy(ir), spectrum(ir), edc(ir), arrival(ir) from measurements limit 2",
    "select * from mcap('flat', '/environment') where temperature_c between 10 and 30",
    "select * from mcap_topics('flat') order by messages",
    "select log_time_ns, message from events where message ilike '%again%' and level in ('warning', 'error')",
    "select * from runs version as of 1",
    "select case when x > 0 then sqrt(x) else null end from (values (1.0), (-1.0), ('NaN'::double)) v(x)",
    "explain analyze select approx_percentile_cont(tnce_total, 0.5) from tnce union all select 1 except select 2",
    "select cast('2026-01-05T08:00:00Z' as timestamp) at time zone 'UTC', interval '3 months', date_trunc('hour', \
        now())",
    "select array_agg(distinct pair_id order by pair_id)[1:3], map(['a'], [1])['a'], struct(1, 'x') from pairs",
    "select regexp_replace(surface_id, '(a+)+$', repeat('b', 10)), substr(surface_id, -1, 3) from surfaces",
];

/// Words and values that readers of SQL stumble over.
const ODD: [&str; 40] = [
    "null",
    "''",
    "'\u{0}'",
    "\"\"",
    "(",
    ")",
    "[",
    "]",
    "{",
    "}",
    ",",
    ";",
    "--",
    "/*",
    "*/",
    "$1",
    "?",
    "::",
    "->",
    "%",
    "9223372036854775807",
    "-9223372036854775808",
    "1e309",
    "-0.0",
    "'NaN'::double",
    "0x",
    "1e",
    "'\u{1f3b5}'",
    "\u{202e}",
    "*",
    ".",
    "lateral",
    "recursive",
    "unnest",
    "over ()",
    "array[]",
    "interval '1 y'",
    "not",
    "exists",
    "(select 1)",
];

/// A query of good pieces, of which some are lost, doubled, moved or odd.
pub(super) fn changed(random: &mut ChaCha8Rng) -> String {
    let mut words = words(random);
    for _ in 0..random.random_range(0..=4) {
        change(random, &mut words);
    }
    // Deep nesting is a change of its own.
    if random.random_ratio(1, 50) {
        let depth = random.random_range(1..3000);
        return format!("select {}{}{}", "(".repeat(depth), words.join(" "), ")".repeat(depth));
    }
    words.join(" ")
}

fn words(random: &mut ChaCha8Rng) -> Vec<String> {
    let of = |random: &mut ChaCha8Rng| {
        let good = GOOD.choose(random).copied().unwrap_or_default();
        good.split_inclusive([' ', '(', ')', ',', '\'', '.', '[', ']']).map(str::to_owned).collect::<Vec<_>>()
    };
    let mut words = of(random);
    if random.random_ratio(1, 3) {
        let other = of(random);
        let (a, b) = (random.random_range(0..words.len()), random.random_range(0..other.len()));
        words.splice(a.., other.into_iter().skip(b));
    }
    words
}

fn change(random: &mut ChaCha8Rng, words: &mut Vec<String>) {
    if words.is_empty() {
        words.push("select".to_owned());
    }
    let (at, from) = (random.random_range(0..words.len()), random.random_range(0..words.len()));
    let odd = ODD.choose(random).copied().unwrap_or_default().to_owned();
    match random.random_range(0..6) {
        0 => drop(words.remove(at)),
        1 => words.insert(at, words[from].clone()),
        2 => words.swap(at, from),
        3 => words[at] = odd,
        4 => words.insert(at, odd),
        _ => {
            let letters: Vec<char> = words[at].chars().collect();
            let kept = random.random_range(0..=letters.len());
            words[at] = letters[..kept].iter().chain(['\u{7f}'].iter()).collect();
        }
    }
}
