//! A served lake that loses rows, or is gone: an error over every protocol, never a smaller answer.

use arrow::array::RecordBatch;
use arrow_flight::error::FlightError;
use arrow_flight::sql::client::FlightSqlServiceClient;
use futures::TryStreamExt as _;
use tonic::transport::Endpoint;

use super::postgres::WireClient;
use super::server::{ANSWER_LIMIT, ServedLake};
use super::{get, json, refused, served, sql, wait_until};
use crate::broken_tables::lake;

const COUNT: &str = "select count(*) as n from nce";

fn flight_error(server: &ServedLake, sql: &str) -> Option<String> {
    let asked = async {
        let endpoint = Endpoint::from_shared(format!("http://{}", server.flight_sql)).expect("a URL");
        let channel = endpoint.connect_timeout(ANSWER_LIMIT).timeout(ANSWER_LIMIT).connect().await.expect("connected");
        let mut client = FlightSqlServiceClient::new(channel);
        let info = client.execute(sql.to_owned(), None).await?;
        for ticket in info.endpoint.into_iter().filter_map(|endpoint| endpoint.ticket) {
            let _: Vec<RecordBatch> = client.do_get(ticket).await?.try_collect().await?;
        }
        Ok::<_, FlightError>(())
    };
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(asked).err().map(|error| error.to_string())
}

fn counted(server: &ServedLake) -> bool {
    let answer = sql(server, COUNT);
    answer.status == 200 && json(&answer)[0]["n"] == 135
}

mod slow {
    use super::*;

    #[test]
    fn lost_rows_and_a_lake_that_is_gone_are_errors_over_every_protocol() {
        let place = lake();
        std::fs::remove_dir_all(place.path("lake/tables/nce")).expect("removed");
        let server = served(&place, &[]);
        refused(&sql(&server, COUNT), 503, "lake_unreadable");
        let problem = json(&sql(&server, COUNT)).to_string();
        assert!(problem.contains("expected 45") && problem.contains("`echolake ingest`"), "{problem}");
        refused(&get(&server, "/api/v1/tables/nce"), 503, "lake_unreadable");
        assert_eq!(sql(&server, "select count(*) from tnce").status, 200, "the other tables answer");
        let mut wire = WireClient::connect(&server, None);
        let fields = wire.refusal(COUNT);
        assert_eq!(fields[&'C'], "58030", "{fields:?}");
        assert!(fields[&'H'].contains("`echolake ingest`"), "{fields:?}");
        let error = flight_error(&server, COUNT).expect("refused");
        assert!(error.contains("expected 45"), "{error}");
        wait_until("it is not ready", || get(&server, "/ready").status == 503);

        place.ok(&["ingest"]);
        assert!(counted(&server), "{:?}", sql(&server, COUNT).text());
        wait_until("it is ready", || get(&server, "/ready").status == 200);

        // Within the time for which a snapshot is kept.
        for (from, to) in [("lake/tables", "away"), ("lake", "gone")] {
            std::fs::rename(place.path(from), place.path(to)).expect("moved");
            for query in [COUNT, "select count(*) as n from runs", "select count(*) from surfaces version as of 3"] {
                refused(&sql(&server, query), 503, "lake_unreadable");
            }
            assert!(wire.query(COUNT).is_err() && flight_error(&server, COUNT).is_some());
            wait_until("it is not ready", || get(&server, "/ready").status == 503);
            std::fs::rename(place.path(to), place.path(from)).expect("moved");
            wait_until("it answers again", || counted(&server));
        }

        // A version that never was is the client's fault.
        let never = "select count(*) from nce version as of 999";
        refused(&sql(&server, never), 400, "query_invalid");
        let problem = json(&sql(&server, never)).to_string();
        assert!(problem.contains("its log holds version 0 of ") && problem.contains(" to version "), "{problem}");
        assert_eq!(wire.refusal(never)[&'C'], "42601");
        assert!(flight_error(&server, never).is_some_and(|error| error.contains("no version 999")));
    }
}
