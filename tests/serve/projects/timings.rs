//! Times of counts: rows of other projects make a count no slower than rows that nobody has.

use std::time::{Duration, Instant};

use super::{ProjectScene, WireClient, with_and_without};

/// Tables of the counts; the other tables' rows are those of these.
const COUNTED: [&str; 4] = ["measurements", "nce", "tnce_d4", "heightmaps"];
/// Rounds of each count: as many as a busy machine needs to show the shortest times.
const LEAST_ROUNDS: usize = 3;
const MOST_ROUNDS: usize = 10;
/// Steps that a count spends on a row. If noise hides what few of them cost, more are tried: the time per row grows,
/// the noise does not.
const STEPS_PER_ROW: [u32; 3] = [200_000, 1_000_000, 5_000_000];

// Counts rows of a surface, each of them slowly.
fn slow_count(table: &str, surface: &str, steps: u32) -> String {
    format!(
        "select count(*) as n from {table} t, generate_series(1, {steps}) s \
         where t.surface_id = '{surface}' and s.value * length(t.run_id) % 7 = 3"
    )
}

/// Shortest times of a count of hidden rows, and of one of rows that nobody has.
type CountTimes = [Duration; 2];

/// Fails if the count of hidden rows takes longer by a fourth of what it takes longer for whoever may see them. `count`
/// asks as somebody who may see them, or as one who may not.
fn check_times(asked: &str, table: &str, mut count: impl FnMut(bool, &str)) {
    let mut undecided = Vec::new();
    for steps in STEPS_PER_ROW {
        let statements = ["wood_secret", "wood_nobody"].map(|surface| slow_count(table, surface, steps));
        match compare_times(&statements, &mut count) {
            Ok(()) => return,
            Err(times) => undecided.push((steps, times)),
        }
    }
    panic!("{asked}: steps per row, times for whoever may see the rows, and for others: {undecided:?}");
}

/// Counts until the times show that hidden rows cost nothing; returns the shortest ones if they do not.
fn compare_times(statements: &[String; 2], count: &mut impl FnMut(bool, &str)) -> Result<(), [CountTimes; 2]> {
    let longer = |[hidden, nobody]: CountTimes| hidden.saturating_sub(nobody);
    let [mut theirs, mut ours] = [[Duration::MAX; 2]; 2];
    for round in 1..=MOST_ROUNDS {
        for (may_see, times) in [(true, &mut theirs), (false, &mut ours)] {
            for (statement, shortest) in statements.iter().zip(times) {
                let begun = Instant::now();
                count(may_see, statement);
                *shortest = begun.elapsed().min(*shortest);
            }
        }
        let is_told = longer(theirs) > theirs[1] / 2;
        if round >= LEAST_ROUNDS && is_told && longer(ours) < longer(theirs) / 4 {
            return Ok(());
        }
    }
    Err([theirs, ours])
}

mod slow {
    use super::*;

    #[test]
    fn counts_of_others_rows_take_no_time() {
        let [_, with] = with_and_without();
        let scene = ProjectScene::serve(with);
        let connect = |token: &str| {
            let mut client = WireClient::connect(&scene.server, None);
            assert_eq!(client.log_in(token), None);
            client
        };
        let [mut theirs, mut ours] = [&scene.all, &scene.ours].map(|token| connect(token));
        for table in COUNTED {
            check_times(&format!("{table} over HTTP"), table, |may_see, sql| {
                let answer = scene.sql(sql, if may_see { &scene.all } else { &scene.ours });
                assert!(answer.starts_with("200"), "{sql}: {answer}");
            });
            check_times(&format!("{table} over Postgres' protocol"), table, |may_see, sql| {
                let answer = if may_see { &mut theirs } else { &mut ours }.query(sql);
                assert!(answer.is_ok(), "{sql}: {answer:?}");
            });
        }
    }
}
