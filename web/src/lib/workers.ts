//! The workers of heavy queries, as `system.workers` has them.
import { sql } from './api'

export interface WorkerRow {
  readonly address: string
  readonly state: string
  readonly problem: string | null
  readonly last_seen: string | null
  readonly running_tasks: number | null
  readonly reading_tasks: number | null
  readonly read_bytes: number | null
  readonly store_requests: number | null
}

const QUERY =
  'select address, state, problem, last_seen, running_tasks, reading_tasks, read_bytes, store_requests from system.workers order by address'

export const loadWorkers = async (): Promise<readonly WorkerRow[]> =>
  (await sql(QUERY, 'application/json')).json() as Promise<readonly WorkerRow[]>
