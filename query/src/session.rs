//! A session: every query sees one frozen view of the lake and may only read.

use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use datafusion::execution::SendableRecordBatchStream;
use datafusion::execution::context::SQLOptions;
use datafusion::execution::object_store::ObjectStoreUrl;
use datafusion::execution::runtime_env::RuntimeEnv;
use datafusion::prelude::{SessionConfig, SessionContext};
use echolake_lake::Lake;
use echolake_schema::tables::Table;

use crate::Error;
use crate::table::LakeTable;

/// Where the lake's store is registered; no other store is, so no query reaches a file outside of the lake.
const STORE: &str = "echolake://lake/";
/// Rows a batch: 384 samples each make 3 MB of responses.
const BATCH_ROWS: usize = 2048;

/// Asks a lake in SQL.
pub struct Session {
    lake: Lake,
    config: SessionConfig,
    runtime: Arc<RuntimeEnv>,
    store: ObjectStoreUrl,
}

/// An answer, as it comes.
pub struct Answer {
    /// Its columns.
    pub schema: SchemaRef,
    /// Its rows.
    pub batches: SendableRecordBatchStream,
}

impl Session {
    /// A session on a lake.
    ///
    /// # Errors
    /// [`Error::Execution`] where DataFusion cannot be set up.
    pub fn new(lake: &Lake) -> Result<Self, Error> {
        let store = ObjectStoreUrl::parse(STORE).map_err(|e| Error::execution(&e))?;
        let mut config = SessionConfig::new().with_information_schema(true).with_batch_size(BATCH_ROWS);
        let options = config.options_mut();
        options.sql_parser.collect_spans = true;
        // Files hold plain strings, and so do the formats that answers are written in.
        options.execution.parquet.schema_force_view_types = false;
        let runtime = Arc::new(RuntimeEnv::default());
        runtime.register_object_store(store.as_ref(), lake.store());
        Ok(Self { lake: lake.clone(), config, runtime, store })
    }

    /// Answers a query.
    ///
    /// # Errors
    /// [`Error::Query`] where it is not right, [`Error::NotReading`] where it would change something.
    pub async fn query(&self, sql: &str) -> Result<Answer, Error> {
        let context = self.context().await?;
        let plan = context.state().create_logical_plan(sql).await.map_err(|e| Error::plan(sql, &e))?;
        let reading = SQLOptions::new().with_allow_ddl(false).with_allow_dml(false).with_allow_statements(false);
        reading.verify_plan(&plan).map_err(|e| Error::NotReading { message: crate::error::message(&e) })?;
        let frame = context.execute_logical_plan(plan).await.map_err(|e| Error::plan(sql, &e))?;
        let batches = frame.execute_stream().await.map_err(|e| Error::plan(sql, &e))?;
        Ok(Answer { schema: batches.schema(), batches })
    }

    /// The tables and their schemas.
    pub fn tables(&self) -> impl Iterator<Item = (&'static str, SchemaRef)> {
        Table::ALL.into_iter().map(|t| (t.name(), t.schema(self.lake.rig())))
    }

    // A new one a query: the tables are those of one snapshot, and nothing a query does outlives it.
    async fn context(&self) -> Result<SessionContext, Error> {
        let snapshot = self.lake.snapshot().await?;
        let context = SessionContext::new_with_config_rt(self.config.clone(), self.runtime.clone());
        for table in Table::ALL {
            let files = snapshot.files(table).to_vec();
            let provider = LakeTable::new(table.schema(self.lake.rig()), files, self.store.clone());
            context.register_table(table.name(), Arc::new(provider)).map_err(|e| Error::execution(&e))?;
        }
        Ok(context)
    }
}

#[cfg(test)]
mod tests {
    use arrow::array::AsArray as _;
    use arrow::datatypes::{Float64Type, Int64Type};
    use echolake_lake::References;
    use echolake_schema::Rig;
    use futures::TryStreamExt as _;

    use super::*;

    async fn lake() -> (tempfile::TempDir, Lake) {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let lake = Lake::open_or_create(&url, &Rig::paper(), &References::default()).await.expect("a lake");
        (folder, lake)
    }

    async fn rows(session: &Session, sql: &str) -> Vec<arrow::record_batch::RecordBatch> {
        let answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        answer.batches.try_collect().await.unwrap_or_else(|e| panic!("{sql}: {e}"))
    }

    #[tokio::test]
    async fn tables_are_asked_and_joined() {
        let (_folder, lake) = lake().await;
        let session = Session::new(&lake).expect("a session");
        let count = rows(&session, "select count(*) from pairs").await;
        assert_eq!(count[0].column(0).as_primitive::<Int64Type>().value(0), 2951);
        let highest = rows(
            &session,
            "select max(p.z_mm) from pairs join points p on p.point_id = pairs.speaker where pairs.pair_id > 2900",
        )
        .await;
        assert_eq!(highest[0].column(0).as_primitive::<Float64Type>().value(0), 474.0);
        let one = rows(&session, "select direct_mm from pairs where pair_id = 0").await;
        assert_eq!(one.iter().map(|b| b.num_rows()).sum::<usize>(), 1);
        assert_eq!(
            one.iter().find(|b| b.num_rows() > 0).expect("a row").column(0).as_primitive::<Float64Type>().value(0),
            75.0
        );
        assert_eq!(rows(&session, "select * from measurements").await.iter().map(|b| b.num_rows()).sum::<usize>(), 0);
        assert!(!rows(&session, "show tables").await.is_empty());
        assert!(!rows(&session, "describe measurements").await.is_empty());
        assert!(!rows(&session, "explain select * from runs").await.is_empty());
    }

    #[tokio::test]
    async fn nothing_but_reading_is_allowed() {
        let (folder, lake) = lake().await;
        let session = Session::new(&lake).expect("a session");
        let outside = folder.path().join("out.csv");
        for sql in [
            "create table x as select 1".to_owned(),
            "drop table runs".to_owned(),
            "insert into points values (1)".to_owned(),
            "delete from runs".to_owned(),
            format!("copy (select 1) to '{}'", outside.display()),
            "set datafusion.execution.batch_size = 1".to_owned(),
            "create external table x stored as parquet location '/etc'".to_owned(),
            "begin".to_owned(),
        ] {
            let error = session.query(&sql).await.map(drop).expect_err(&sql);
            assert!(matches!(error, Error::NotReading { .. } | Error::Query { .. }), "{sql}: {error}");
        }
        assert!(!outside.exists());
        let file = format!("select * from '{}'", folder.path().join("lake/lake.toml").display());
        assert!(session.query(&file).await.is_err(), "files are no tables");
        assert_eq!(rows(&session, "select * from points").await.iter().map(|b| b.num_rows()).sum::<usize>(), 78);
    }

    #[tokio::test]
    async fn errors_point_at_the_place() {
        let (_folder, lake) = lake().await;
        let session = Session::new(&lake).expect("a session");
        let check = async |sql: &str, expected: &[&str]| {
            let error = session.query(sql).await.map(drop).expect_err(sql).to_string();
            for text in expected {
                assert!(error.contains(text), "{sql}: {error}");
            }
        };
        check("select nonsense from runs", &["nonsense", "\n  select nonsense from runs\n         ^"]).await;
        check("selec 1", &["selec", "^"]).await;
        check("select * from rums", &["rums"]).await;
    }
}
