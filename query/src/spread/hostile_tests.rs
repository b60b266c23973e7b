//! Plans that no engine sends, from somebody who knows the token: a worker answers each with an error, and nothing else
//! happens.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::{FileGroup, FileScanConfigBuilder, ParquetSource};
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::Result;
use datafusion::execution::SessionStateBuilder;
use datafusion::execution::object_store::ObjectStoreUrl;
use datafusion::physical_plan::ExecutionPlan;
use datafusion::physical_plan::metrics::ExecutionPlanMetricsSet;
use datafusion::prelude::SessionContext;
use datafusion_distributed::{
    ChannelResolver as _, DistributedExt as _, ExecuteTaskRequest, MaybeEncoded, ProducerHead,
    SessionStateBuilderExt as _, SetPlanRequest, TaskKey,
};
use echolake_lake::Lake;
use futures::StreamExt as _;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore as _, ObjectStoreExt as _};
use tonic::codegen::http::HeaderMap;
use url::Url;
use uuid::Uuid;

use super::affinity::QueryWorkers;
use super::channels::WorkerChannels;
use super::tests::{TestWorker, read_answer, row_texts, write_run_file};
use super::*;
use crate::plan_transport::McapCodec;
use crate::session::function_tests::SmallLake;

/// Places of a plan in which a byte is changed.
const CHANGES: usize = 200;

/// Somebody who knows how engines talk with workers.
struct HostileClient {
    worker: Url,
    channels: WorkerChannels,
    context: SessionContext,
}

impl HostileClient {
    fn new(worker: &TestWorker) -> Self {
        let worker: Url = format!("http://{}", worker.address).parse().expect("a URL");
        let channels = WorkerChannels::new(&WorkerLink::default()).expect("channels");
        let workers = QueryWorkers::new(vec![worker.clone()], true);
        let state = SessionStateBuilder::new()
            .with_default_features()
            .with_distributed_worker_resolver(workers)
            .with_distributed_channel_resolver(channels.clone())
            .with_distributed_user_codec(McapCodec::default())
            .with_distributed_planner()
            .build();
        let context = SessionContext::new_with_state(state);
        // Here, and not at the worker, the plans' stores can be written to.
        for url in ["echolake://lake/", "http://127.0.0.1/", "s3://bucket/"] {
            let url = ObjectStoreUrl::parse(url).expect("a URL");
            context.register_object_store(url.as_ref(), Arc::new(InMemory::new()));
        }
        Self { worker, channels, context }
    }

    async fn plan_query(&self, sql: &str) -> Arc<dyn ExecutionPlan> {
        let query = self.context.sql(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        query.create_physical_plan().await.unwrap_or_else(|e| panic!("{sql}: {e}"))
    }

    // The number of rows that the worker answers.
    async fn send_plan(&self, plan: Arc<dyn ExecutionPlan>) -> Result<usize> {
        self.send_encoded(MaybeEncoded::Decoded(plan)).await
    }

    async fn send_encoded(&self, plan: MaybeEncoded<Arc<dyn ExecutionPlan>>) -> Result<usize> {
        let context = self.context.task_ctx();
        let task_key = TaskKey { query_id: Uuid::new_v4(), stage_id: 1, task_number: 0 };
        let request = SetPlanRequest {
            task_key,
            task_count: 1,
            plan,
            work_unit_feed_declarations: Vec::new(),
            target_worker_url: self.worker.clone(),
            query_start_time_ns: 0,
        };
        let mut client = self.channels.get_worker_client_for_url(&self.worker).await?;
        let (silence, metrics) = (futures::stream::pending().boxed(), ExecutionPlanMetricsSet::new());
        let _open = client.coordinator_channel(HeaderMap::new(), request, silence, metrics.clone(), &context).await?;
        let (target_partition_start, target_partition_end) = (0, 1);
        let producer_head = ProducerHead::None;
        let request = ExecuteTaskRequest { task_key, target_partition_start, target_partition_end, producer_head };
        let mut rows = 0;
        for mut stream in client.execute_task(HeaderMap::new(), request, metrics, &context).await? {
            while let Some(batch) = stream.next().await {
                rows += batch?.num_rows();
            }
        }
        Ok(rows)
    }
}

fn number_schema() -> SchemaRef {
    Arc::new(Schema::new(vec![Field::new("n", DataType::Int64, true)]))
}

fn plan_scan(store: &str, path: &str) -> Arc<dyn ExecutionPlan> {
    let url = ObjectStoreUrl::parse(store).expect("a URL");
    let file = PartitionedFile::new(path, 1000);
    let config = FileScanConfigBuilder::new(url, Arc::new(ParquetSource::new(number_schema())))
        .with_file_groups(vec![FileGroup::new(vec![file])])
        .build();
    DataSourceExec::from_data_source(config)
}

/// All objects of a lake with their ETags or times.
async fn list_objects(lake: &Lake) -> BTreeMap<Path, (u64, i64)> {
    let store = lake.store();
    let listed = store.list(None).map(|object| object.expect("an object"));
    listed.map(|object| (object.location, (object.size, object.last_modified.timestamp_micros()))).collect().await
}

mod slow {
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn changed_bytes_of_a_plan_end_no_worker() {
        let small = SmallLake::new().await;
        small.lake.store().put(&Path::from("inbox/a.mcap"), write_run_file(10).into()).await.expect("written");
        let worker = TestWorker::start(&small.lake).await;
        let client = HostileClient::new(&worker);
        let session = crate::Session::new(&small.lake).expect("a session");
        for (sql, file) in [
            ("select surface_id, pair_id, ir from measurements where pair_id < 7", "tables/"),
            ("select x, name from mcap('inbox/a.mcap', '/point')", "inbox/a.mcap"),
        ] {
            let (_, expected) = read_answer(&session, sql).await.expect("rows");
            let expected = row_texts(&expected, false).len();
            let plan = session.plan_locally(sql).await;
            assert_eq!(client.send_plan(plan.clone()).await.expect("rows"), expected, "{sql}");
            let encoded = MaybeEncoded::Decoded(plan).encode(&client.context.task_ctx()).expect("encoded");
            // Bytes of the plan changed: rows or an error, and a worker that goes on.
            for place in (0..encoded.len()).step_by(encoded.len().div_ceil(CHANGES)) {
                let mut changed = encoded.clone();
                changed[place] = changed[place].wrapping_add(1);
                drop(client.send_encoded(MaybeEncoded::Encoded(changed)).await);
            }
            let name = encoded.windows(file.len()).position(|bytes| bytes == file.as_bytes());
            let name = name.expect("the plan names its file");
            for other in [b"lake.to", b"../../t", b"/etc/pa"] {
                let mut changed = encoded.clone();
                changed[name..name + other.len()].copy_from_slice(other);
                assert!(client.send_encoded(MaybeEncoded::Encoded(changed)).await.is_err(), "{sql}");
            }
            let answered = client.send_encoded(MaybeEncoded::Encoded(encoded)).await;
            assert_eq!(answered.expect("rows"), expected, "{sql}");
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn hostile_plans_have_no_effect() {
        let small = SmallLake::new().await;
        let worker = TestWorker::start(&small.lake).await;
        let client = HostileClient::new(&worker);
        let outside = tempfile::tempdir().expect("a folder");
        let secret = outside.path().join("secret.parquet");
        let write = format!("copy (select column1 as n from (values (1), (2))) to '{}'", secret.display());
        client.context.sql(&write).await.expect("a plan").collect().await.expect("a file outside of the lake");
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        listener.set_nonblocking(true).expect("it does not wait");
        let elsewhere = format!("http://{}/", listener.local_addr().expect("an address"));
        let before = list_objects(&small.lake).await;

        // The way is right: a plan without harm is answered.
        assert_eq!(
            client.send_plan(client.plan_query("select * from (values (1), (2), (3))").await).await.expect("rows"),
            3
        );
        let path = |path: &std::path::Path| path.display().to_string();
        let new_file = path(&outside.path().join("new.parquet"));
        let mut plans = vec![
            plan_scan("file:///", &path(&secret)),
            plan_scan(&elsewhere, "a.parquet"),
            plan_scan("s3://bucket/", "a.parquet"),
            plan_scan("echolake://other/", "a.parquet"),
            // Not below the lake.
            plan_scan("echolake://lake/", "../secret.parquet"),
        ];
        for target in
            ["echolake://lake/tables/nce/evil.parquet", "echolake://lake/lake.toml", "s3://bucket/a.parquet", &new_file]
        {
            for format in ["parquet", "csv", "json"] {
                let sql = format!("copy (select column1 as n from (values (1), (2))) to '{target}' stored as {format}");
                // Formats that this build does not have cannot be asked for.
                if let Ok(query) = client.context.sql(&sql).await
                    && let Ok(plan) = query.create_physical_plan().await
                {
                    plans.push(plan);
                }
            }
        }
        assert!(plans.len() >= 9, "{} plans: there are sinks among them", plans.len());
        for plan in plans {
            let text = datafusion::physical_plan::displayable(plan.as_ref()).one_line().to_string();
            let answered = client.send_plan(plan).await;
            assert!(answered.is_err(), "{text}: {answered:?}");
        }
        // What is no plan.
        for garbage in [Vec::new(), vec![0xff; 64], b"select 1".to_vec()] {
            let answered = client.send_encoded(MaybeEncoded::Encoded(garbage.clone())).await;
            assert!(answered.is_err(), "{garbage:?}: {answered:?}");
        }
        assert_eq!(list_objects(&small.lake).await, before, "the lake is as it was");
        let files: Vec<_> = std::fs::read_dir(outside.path()).expect("a folder").flatten().collect();
        assert_eq!(files.len(), 1, "{files:?}");
        assert!(listener.accept().is_err(), "nobody connects elsewhere");
        let rows = client.send_plan(client.plan_query("select * from (values (1), (2), (3))").await).await;
        assert_eq!(rows.expect("it works as before"), 3);
    }
}
