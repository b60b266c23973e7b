//! A query as code for other programs.
import type { Lake } from './api'

export const EXAMPLES: readonly { title: string; query: (lake: Lake) => string }[] = [
  {
    title: 'Quietest surfaces',
    query: () =>
      "select surface_id, p90_mean_db, spread_db\nfrom surface_stats\nwhere band = 'total'\norder by p90_mean_db\nlimit 20",
  },
  {
    title: 'Levels against Flat by band',
    query: (lake) =>
      `select surface_id,\n${lake.bands.map((b) => `  against_flat_${b.key}_db as "${b.label}"`).join(',\n')}\nfrom catalogue\norder by surface_id`,
  },
  {
    title: 'Incidence and level of one surface',
    query: (lake) =>
      `select p.incidence_deg, 10 * log10(t.tnce_band_${lake.bands[Math.min(2, lake.bands.length - 2)].key}) as against_flat_db\nfrom tnce t join pairs p using (pair_id)\nwhere t.surface_id = (select min(surface_id) from surfaces where typology <> 'reference')\norder by p.incidence_deg`,
  },
  {
    title: 'One impulse response',
    query: () =>
      "select surface_id, pair_id, temperature_c, snr_db, ir\nfrom measurements\nwhere surface_id = 'flat' and pair_id = 0",
  },
  {
    title: 'Signal to noise by attempt',
    query: () =>
      'select attempt, count(*) as measurements, avg(snr_db) as snr_db, min(snr_db) as lowest_db\nfrom measurements\ngroup by attempt\norder by attempt',
  },
  {
    title: 'Temperature by hour',
    query: () =>
      "select date_trunc('hour', log_time) as hour, avg(temperature_c) as temperature_c, max(outside_level_db) as outside_db\nfrom environment\ngroup by 1\norder by 1",
  },
  {
    title: 'Why measurements were repeated',
    query: () => "select run_id, log_time, message\nfrom events\nwhere level = 'warning'\norder by log_time\nlimit 100",
  },
  {
    title: 'Flat and Foam of every surface',
    query: () =>
      'select flat_reference, foam_reference, count(*) as surfaces\nfrom surfaces\ngroup by 1, 2\norder by 3 desc',
  },
]

const pythonText = (query: string) => `"""${query.replaceAll('\\', '\\\\').replaceAll('"""', '\\"\\"\\"')}"""`

export const LANGUAGES = ['curl', 'Python', 'DuckDB', 'Rust'] as const
export type Language = (typeof LANGUAGES)[number]

export function snippet(language: Language, query: string, origin: string, tables: readonly string[]): string {
  const url = `${origin}/api/v1/sql`
  // Those of the schema `system` are no Delta tables.
  const named = tables.filter((name) => !name.includes('.') && new RegExp(`\\b${name}\\b`, 'i').test(query))
  switch (language) {
    case 'curl':
      return `curl --fail-with-body ${url} \\\n  -H 'content-type: application/json' -H 'accept: text/csv' \\\n  -d '${JSON.stringify({ query }).replaceAll("'", "'\\''")}'`
    case 'Python':
      return `# pip install adbc-driver-flightsql pyarrow; the server runs with --flight-sql 0.0.0.0:50051\nimport adbc_driver_flightsql.dbapi as flight_sql\n\nquery = ${pythonText(query)}\nwith flight_sql.connect("grpc://${new URL(origin).hostname}:50051") as connection:\n    with connection.cursor() as cursor:\n        cursor.execute(query)\n        table = cursor.fetch_arrow_table()\nprint(table)`
    case 'DuckDB':
      return `-- In the lake's folder\ninstall delta; load delta;\n${named.map((name) => `create view ${name} as select * from delta_scan('tables/${name}');`).join('\n')}\n${query};`
    case 'Rust':
      return `// arrow = "59", reqwest = { version = "0.12", features = ["blocking", "json"] }, serde_json = "1"\nuse arrow::ipc::reader::StreamReader;\n\nfn main() -> Result<(), Box<dyn std::error::Error>> {\n    let query = r##"${query}"##;\n    let answer = reqwest::blocking::Client::new()\n        .post("${url}")\n        .json(&serde_json::json!({ "query": query }))\n        .send()?\n        .error_for_status()?;\n    for batch in StreamReader::try_new(answer, None)? {\n        println!("{} rows", batch?.num_rows());\n    }\n    Ok(())\n}`
  }
}
