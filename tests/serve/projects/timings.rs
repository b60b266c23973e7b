//! Times of counts: rows of other projects make a count no slower than rows that nobody has.

use std::time::{Duration, Instant};

use super::{ProjectScene, WireClient, with_and_without};

/// Tables of the counts; the other tables' rows are those of these.
const COUNTED: [&str; 4] = ["measurements", "nce", "tnce_d4", "heightmaps"];
/// Times that each count is repeated.
const REPETITIONS: usize = 7;

// Counts rows of a surface, each of them slowly.
fn slow_count(table: &str, surface: &str) -> String {
    format!(
        "select count(*) as n from {table} t, generate_series(1, 200000) s \
         where t.surface_id = '{surface}' and s.value * length(t.run_id) % 7 = 3"
    )
}

/// Shortest times of a count of hidden rows, and of one of rows that nobody has, in turn.
fn shortest_times(table: &str, mut count: impl FnMut(&str)) -> [Duration; 2] {
    let statements = ["wood_secret", "wood_nobody"].map(|surface| slow_count(table, surface));
    let mut times = [Duration::MAX; 2];
    for _ in 0..REPETITIONS {
        for (statement, shortest) in statements.iter().zip(&mut times) {
            let begun = Instant::now();
            count(statement);
            *shortest = begun.elapsed().min(*shortest);
        }
    }
    times
}

/// Fails if the count of hidden rows takes longer by a fourth of what it takes longer for whoever may see them.
fn check_times(asked: &str, theirs: [Duration; 2], ours: [Duration; 2]) {
    let longer = |[hidden, nobody]: [Duration; 2]| hidden.saturating_sub(nobody);
    assert!(longer(theirs) > theirs[1] / 2, "{asked}: these times say nothing: {theirs:?}");
    assert!(longer(ours) < longer(theirs) / 4, "{asked}: {ours:?}, and {theirs:?} for whoever may see them");
}

#[test]
fn counts_of_others_rows_take_no_time() {
    let [_, with] = with_and_without();
    let scene = ProjectScene::serve(with);
    let connect = |token: &str| {
        let mut client = WireClient::connect(&scene.server, None);
        assert_eq!(client.log_in(token), None);
        client
    };
    let mut clients = [&scene.all, &scene.ours].map(|token| connect(token));
    for table in COUNTED {
        let http = [&scene.all, &scene.ours].map(|token| {
            shortest_times(table, |sql| {
                let answer = scene.sql(sql, token);
                assert!(answer.starts_with("200"), "{sql}: {answer}");
            })
        });
        check_times(&format!("{table} over HTTP"), http[0], http[1]);
        let [theirs, ours] = clients.each_mut().map(|client| {
            shortest_times(table, |sql| {
                let answer = client.query(sql);
                assert!(answer.is_ok(), "{sql}: {answer:?}");
            })
        });
        check_times(&format!("{table} over Postgres' protocol"), theirs, ours);
    }
}
