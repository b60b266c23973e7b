//! Queries of the operations page: the server's own tables by SQL, and its figures as Prometheus gets them.
import { figures, sql } from './api'

/** Begins each statement of the page, so that its list of queries can leave them out. */
const MARK = '/* operations page */'

export interface InboxFile {
  readonly state: 'waiting' | 'recording' | 'incomplete' | 'refused' | 'unusable'
  readonly path: string
  readonly bytes: number
  readonly changed: string
  readonly reason: string | null
}

export interface ServerQuery {
  readonly id: number
  readonly client: string
  readonly protocol: string
  readonly statement: string | null
  readonly outcome: string
  readonly started: string
  readonly seconds: number
  readonly rows: number | null
  readonly memory_bytes: number | null
}

export interface ServerConnection {
  readonly id: number
  readonly client: string | null
  readonly protocol: string
  readonly peer: string
  readonly started: string
  readonly requests: number
  readonly is_working: boolean
}

export interface RunIngest {
  readonly ingested: string | null
  readonly version: number | null
  readonly run_id: string
  readonly state: string
  readonly measurements: number
  readonly damaged: number
  readonly code_version: string
}

export interface TableVersion {
  readonly table: string
  readonly version: number
  readonly committed: string
  readonly operation: string | null
  readonly files_added: number
  readonly files_removed: number
  readonly rows_added: number | null
  readonly rows_removed: number | null
}

export interface StoredPart {
  readonly part: string
  readonly files: number
  readonly rows: number | null
  readonly bytes: number | null
}

export const INBOX_QUERY = `select state, path, bytes, changed, reason
from system.inbox
order by changed desc`

export const QUERY_FILTERS = {
  all: 'true',
  running: "outcome = 'running'",
  failed: "outcome not in ('running', 'answered')",
} as const
export type QueryFilter = keyof typeof QUERY_FILTERS

export const queriesQuery = (filter: QueryFilter, most: number) =>
  `select id, client, protocol, statement, outcome, started,
  coalesce(seconds, date_part('epoch', now() - started)) as seconds, rows, memory_bytes
from system.queries
where ${QUERY_FILTERS[filter]} and coalesce(statement, '') not like '${MARK}%'
order by outcome <> 'running', started desc
limit ${most}`

export interface RunningQueries {
  readonly running: number
}

/** What the list counts, which the figure of the server does not: it has this page's own queries in it. */
export const RUNNING_QUERY = `select count(*) as running
from system.queries
where ${QUERY_FILTERS.running} and coalesce(statement, '') not like '${MARK}%'`

export const CONNECTIONS_QUERY = `select id, client, protocol, peer, started, requests, is_working
from system.connections
order by is_working desc, started`

export const ingestsQuery = (
  most: number,
) => `select ingested, version, run_id, state, measurements, damaged, code_version
from system.ingests
order by ingested desc nulls last, run_id
limit ${most}`

export const versionsQuery = (
  most: number,
) => `select "table", version, committed, operation, files_added, files_removed, rows_added, rows_removed
from system.versions
order by committed desc, "table"
limit ${most}`

export const STORAGE_QUERY = `select "table" as part, count(*) as files, sum(rows) as rows, sum(bytes) as bytes
from system.files group by 1
union all select 'run files', count(*), null, sum(file_bytes) from runs
order by bytes desc nulls last`

/** The rows of one of these, as they are now. */
export async function rowsNow<T>(query: string): Promise<readonly T[]> {
  return (await sql(`${MARK} ${query}`, 'application/json')).json() as Promise<readonly T[]>
}

/** The server's figures by their names, as `echolake_connections{protocol="http"}`. */
export type ServerFigures = ReadonlyMap<string, number>

/** They are numbers, each on a line of its own behind its name. */
export function parseFigures(text: string): ServerFigures {
  const lines = text.split('\n').filter((line) => line !== '' && !line.startsWith('#'))
  return new Map(lines.map((line) => [line.slice(0, line.lastIndexOf(' ')), Number(line.slice(line.lastIndexOf(' ')))]))
}

export const figuresNow = async (): Promise<ServerFigures> => parseFigures(await figures())

export interface DriftAlarm {
  readonly surface_id: string
  readonly band: string
  readonly run_id: string
  readonly started: string
  readonly alarm: 'shift' | 'outlier'
  readonly size_db: number
}

export const DRIFT_QUERY = `select surface_id, band, run_id, started, alarm,
  case alarm when 'shift' then shift_db else level_db - mean_db end as size_db
from flat_drift
where alarm is not null
order by started desc, band_hz`
