//! A query as code for other programs.
import type { Lake } from './api'

/** A query to begin with. */
export interface ExampleQuery {
  readonly title: string
  readonly query: (lake: Lake) => string
  /** It has no rows in a lake without Flat and Foam. */
  readonly needsLevels?: boolean
}

export const EXAMPLES: readonly ExampleQuery[] = [
  {
    title: 'Quietest surfaces',
    needsLevels: true,
    query: () =>
      "select surface_id, p90_mean_db, spread_db\nfrom surface_stats\nwhere band = 'total'\norder by p90_mean_db\nlimit 20",
  },
  {
    title: 'Levels against Flat by band',
    needsLevels: true,
    query: (lake) =>
      `select surface_id,\n${lake.bands.map((b) => `  against_flat_${b.key}_db as "${b.label}"`).join(',\n')}\nfrom catalogue\norder by surface_id`,
  },
  {
    title: 'Incidence and level of one surface',
    needsLevels: true,
    query: (lake) =>
      `select p.incidence_deg, 10 * log10(t.tnce_band_${lake.bands[Math.min(2, lake.bands.length - 2)].key}) as against_flat_db\nfrom tnce t join pairs p using (pair_id)\nwhere t.surface_id = (select min(surface_id) from surfaces where typology <> 'reference')\norder by p.incidence_deg`,
  },
  {
    title: 'One impulse response',
    query: () =>
      'select surface_id, pair_id, temperature_c, snr_db, ir\nfrom measurements\nwhere surface_id = (select max(surface_id) from measurements) and pair_id = 0',
  },
  {
    title: 'Signal to noise of each response',
    query: () =>
      'select surface_id, pair_id, snr_db, clipped_samples, arrival_error_us\nfrom measurements\norder by snr_db\nlimit 100',
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
    needsLevels: true,
    query: () =>
      'select flat_reference, foam_reference, count(*) as surfaces\nfrom surfaces\ngroup by 1, 2\norder by 3 desc',
  },
]

/** The examples that have rows in a lake. */
export const lakeExamples = (lake: Lake) => EXAMPLES.filter((one) => lake.has_levels || !one.needsLevels)

export const LANGUAGES = ['curl', 'Python', 'polars', 'DuckDB'] as const
export type Language = (typeof LANGUAGES)[number]

const shellText = (text: string) => `'${text.replaceAll("'", "'\\''")}'`
/** Three quotes in a row, and one at the end, would close the text. */
const pythonText = (text: string) => `"""${text.replaceAll('\\', '\\\\').replace(/"(?="|$)/g, '\\"')}"""`
const curl = (url: string, query: string, accept: string) =>
  `curl --fail-with-body ${url} \\\n  -H 'content-type: application/json' -H 'accept: ${accept}' \\\n  -d ${shellText(JSON.stringify({ query }))}`

const pythonRequest = (library: string, imported: string, format: string, url: string, query: string, read: string) =>
  `# pip install ${library}; a server with tokens: "authorization": "Bearer TOKEN" among the headers
import json
import urllib.request

${imported}

query = ${pythonText(query)}
request = urllib.request.Request(
    "${url}",
    data=json.dumps({"query": query, "format": "${format}"}).encode(),
    headers={"content-type": "application/json"},
)
with urllib.request.urlopen(request) as answer:
    ${read}
print(table)`

/** A query as code that asks the server of this page; every one runs as it is if the server has no tokens. */
export function snippet(language: Language, query: string, origin: string): string {
  const url = `${origin}/api/v1/sql`
  switch (language) {
    case 'curl':
      return `# A server with tokens: -H 'authorization: Bearer TOKEN'\n${curl(url, query, 'text/csv')}`
    case 'Python':
      return pythonRequest(
        'pyarrow',
        'import pyarrow.ipc',
        'arrow',
        url,
        query,
        'table = pyarrow.ipc.open_stream(answer).read_all()',
      )
    case 'polars':
      return pythonRequest(
        'polars',
        'import polars',
        'parquet',
        url,
        query,
        'table = polars.read_parquet(answer.read())',
      )
    case 'DuckDB':
      return `# The server answers in its own SQL, DuckDB reads the answer; a server with tokens: -H 'authorization: Bearer TOKEN'\n${curl(url, query, 'application/vnd.apache.parquet')} -o answer.parquet\nduckdb -c "from 'answer.parquet'"`
  }
}

/** The command that opens a run's file in rerun on this machine, with the rig's views. */
export const rerunCommand = (url: string) => `python -m echolake.rerun ${shellText(url)}`
