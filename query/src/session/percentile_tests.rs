//! Percentiles that share their values have the bits that they have alone.

use datafusion::physical_plan::displayable;

use super::eager_aggregation_tests::varied_lake;
use super::plan_tests::{plan_in, row_texts};
use super::*;

/// Names of the lists of shared percentiles begin so.
const SHARED: &str = "__percentiles_";

/// Runs a query with the rule and without it; returns the plan with it.
async fn check_percentiles(engine: &QueryEngine, sql: &str) -> String {
    let contexts = [(); 2].map(|()| engine.create_context());
    let [without, with] = &contexts;
    assert!(without.remove_optimizer_rule("percentile_calls"));
    let (state, plan) = plan_in(without, engine, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let expected_schema = plan.schema();
    let expected = row_texts(plan, &state).await;
    let (state, plan) = plan_in(with, engine, sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let text = displayable(plan.as_ref()).indent(false).to_string();
    assert_eq!(expected_schema, plan.schema(), "{sql}");
    assert_eq!(expected, row_texts(plan, &state).await, "{sql}: {text}");
    text
}

fn within(share: f64, order: &str) -> String {
    format!("percentile_cont({share}) within group (order by {order})")
}

#[tokio::test(flavor = "multi_thread")]
async fn shared_percentiles_have_the_same_bits() {
    let (_folder, lake) = varied_lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let shares = [0.05, 0.0, 0.25, 1.0 / 3.0, 0.5, 0.95, 1.0, 0.05];
    let sources = [
        ("tnce", "tnce_10000", "surface_id"),
        ("tnce", "tnce_total * 2 - 1", "pair_id % 3"),
        ("tnce", "rise_2500_ms", "surface_id"),
        ("measurements", "snr_db", "verdict"),
        ("measurements", "temperature_c", "true"),
        ("measurements where snr_db > 1e9", "snr_db", "verdict"),
        ("pairs", "direct_mm", "microphone"),
        (
            "(values (1, 'nan'::double), (1, -0.0), (1, 0.0), (2, 'inf'::double), (2, null), (3, null)) v(k, x)",
            "x",
            "k",
        ),
    ];
    for (source, values, group) in sources {
        let mut calls: Vec<_> = shares.map(|share| within(share, values)).into();
        calls.extend([0.1, 0.5].map(|share| within(share, &format!("{values} desc"))));
        calls.push(format!("median({values})"));
        calls.push(format!("count({values})"));
        calls.push(format!("percentile_cont({values}, 0.7)"));
        calls.push(format!("{} filter (where {group} is not null)", within(0.5, values)));
        let calls: Vec<_> = calls.iter().enumerate().map(|(n, call)| format!("{call} as c{n}")).collect();
        let calls = calls.join(", ");
        let whole = format!("select {calls} from {source}");
        let grouped = format!("select {group} as g, {calls} from {source} group by 1");
        for sql in [&whole, &grouped] {
            let plan = check_percentiles(&engine, sql).await;
            // The least and the greatest value are named after their percentiles.
            let is_other = |line: &&str| {
                line.contains("AggregateExec") && line.replace(" as percentile_cont(", "").contains("percentile_cont(")
            };
            let others = plan.lines().filter(is_other);
            assert!(plan.contains(SHARED) && others.count() == 0 && !plan.contains("SortExec"), "{sql}: {plan}");
        }
    }
}

#[tokio::test]
async fn percentiles_stand_anywhere_in_a_query() {
    let (_folder, lake) = varied_lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let low = within(0.1, "tnce_total");
    let high = within(0.9, "tnce_total");
    let other = within(0.9, "energy_total");
    for sql in [
        format!(
            "select surface_id, {high} - {low} as width from tnce group by 1 having {low} < 2 order by {high}, 1 limit 2"
        ),
        format!(
            "select surface_id, verdict, {low}, {high} from tnce join measurements using (surface_id, run_id, pair_id) \
                 group by rollup(surface_id, verdict)"
        ),
        format!("select pair_id from tnce where tnce_total > (select {high} + 0 * {low} from tnce)"),
        format!("select {low}, {other}, quantile_cont(0.2) within group (order by energy_total) from tnce"),
        format!("select p.microphone, {low}, count(*) from tnce t join pairs p using (pair_id) group by 1"),
        format!(
            "select * from (select surface_id, {low} as a, {high} as b from tnce group by 1) x join surfaces s \
                 on s.surface_id = x.surface_id where a < b"
        ),
    ] {
        let plan = check_percentiles(&engine, &sql).await;
        assert!(plan.contains(SHARED), "{sql}: {plan}");
    }
    for sql in [
        "select median(tnce_total), median(energy_total) from tnce",
        "select median(attempt), median(attempt + 1) from measurements",
        "select percentile_cont(0.5) within group (order by attempt), median(attempt) from measurements",
        "select median(distinct tnce_total), median(tnce_total) from tnce",
        "select approx_percentile_cont(0.5) within group (order by tnce_total) from tnce",
        "select pair_id, median(tnce_total) over (partition by surface_id) from tnce",
    ] {
        let plan = check_percentiles(&engine, sql).await;
        assert_eq!(plan.contains(SHARED), sql.contains("order by attempt"), "{sql}: {plan}");
    }
}

#[tokio::test]
async fn no_statement_names_shared_percentiles() {
    let (_folder, lake) = varied_lake().await;
    let session = Session::new(&lake).expect("a session");
    assert!(session.query("select shared_percentiles(tnce_total, 0.5) from tnce").await.is_err());
    let beyond = format!("select {} from tnce", within(1.5, "tnce_total"));
    let error = match session.query(&beyond).await {
        Ok(mut answer) => answer.next().await.expect_err("no percentile"),
        Err(error) => error,
    };
    assert!(error.to_string().contains("between 0.0 and 1.0"), "{error}");
}
