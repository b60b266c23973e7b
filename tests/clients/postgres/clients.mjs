// Checks a server with Node's clients of Postgres: `clients.mjs URL QUERIES` prints a JSON object per check, with `error` if it
// failed, and one per query of the file.
import knex from "knex";
import pg from "pg";
import Cursor from "pg-cursor";
import postgres from "postgres";
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";

const url = process.argv[2];

async function check(name, act, expected) {
  try {
    const value = await act();
    if (expected !== undefined) assert.deepEqual(value, expected);
    console.log(JSON.stringify({ check: name }));
  } catch (error) {
    console.log(JSON.stringify({ check: name, error: String(error.message ?? error).slice(0, 600) }));
  }
}

const client = new pg.Client(url);
await client.connect();
const one = async (text, values) => Object.values((await client.query({ text, values, rowMode: "array" })).rows[0]);
await check("pg: select 1, 1", () => one("select 1, 1"), [1, 1]);
await check("pg: $1::int", () => one("select $1::int", [7]), [7]);
await check("pg: limit $1 offset $2", () => one("select pair_id from pairs order by 1 limit $1 offset $2", [1, 2]), [2]);
await check("pg: any", () => one("select count(*)::int from pairs where pair_id = any($1)", [[1, 2, 5]]), [3]);
await check("pg: any of a cast", () => one("select count(*)::int from pairs where pair_id = any($1::int[])", [[1, 2]]), [2]);
await check("pg: a time", async () => (await one("select $1::timestamptz", [new Date(0)]))[0].getTime(), 0);
await check("pg: a list", async () => Array.isArray((await one("select ir from measurements limit 1"))[0]), true);
await check("pg: null", () => one("select $1::text", [null]), [null]);
await check("pg: boolean", () => one("select $1::boolean", [true]), [true]);
await check("pg: named", async () => {
  for (let i = 0; i < 3; i++) await client.query({ name: "n", text: "select * from pairs where pair_id < $1", values: [i] });
});
await check("pg: several", async () => (await client.query("select 1 as a; select 2 as b")).length, 2);
await check("pg: cursor", async () => {
  const cursor = client.query(new Cursor("select * from pairs limit 9"));
  const rows = await cursor.read(5);
  await cursor.close();
  return rows.length;
}, 5);
await check("pg: an error's code", async () => {
  try {
    await client.query("select * from nope");
  } catch (error) {
    return error.code;
  }
}, "42P01");
// A Date has no microseconds.
const types = { getTypeParser: (number, format) => (number === 1184 ? String : pg.types.getTypeParser(number, format)) };
const printable = (value) => (value === null ? null : Array.isArray(value) ? value.map(printable) : Buffer.isBuffer(value) ? value.toString("hex") : String(value));
for (const line of readFileSync(process.argv[3], "utf8").trim().split("\n")) {
  const [table, text] = line.split("\t");
  try {
    const answer = await client.query({ text, rowMode: "array", types });
    console.log(JSON.stringify({ table, columns: answer.fields.map((f) => [f.name, String(f.dataTypeID)]), rows: answer.rows.map(printable) }));
  } catch (error) {
    console.log(JSON.stringify({ table, error: String(error.message ?? error).slice(0, 600) }));
  }
}
await client.end();
const pool = new pg.Pool({ connectionString: url, max: 2 });
await check("pg: pool", async () => (await Promise.all([1, 2, 3].map((n) => pool.query("select $1::int as n", [n])))).length, 3);
await pool.end();

const sql = postgres(url, { max: 2, onnotice: () => {} });
await check("postgres.js: select", async () => [...(await sql`select 1 as a`)], [{ a: 1 }]);
await check("postgres.js: value", async () => (await sql`select count(*)::int as n from pairs where pair_id < ${5}`)[0].n, 5);
await check("postgres.js: in", async () => (await sql`select count(*)::int as n from pairs where pair_id in ${sql([1, 2])}`)[0].n, 2);
await check("postgres.js: any", async () => (await sql`select count(*)::int as n from pairs where pair_id = any(${[1, 2, 3]})`)[0].n, 3);
await check("postgres.js: limit", async () => (await sql`select * from pairs limit ${4}`).length, 4);
await check("postgres.js: identifier", async () => (await sql`select ${sql("pair_id")} from ${sql("pairs")} limit 1`).length, 1);
await check("postgres.js: a list", async () => Array.isArray((await sql`select ir from measurements limit 1`)[0].ir), true);
await check("postgres.js: cursor", async () => {
  let count = 0;
  await sql`select * from pairs limit 20`.cursor(7, (rows) => { count += rows.length; });
  return count;
}, 20);
await check("postgres.js: transaction", async () => (await sql.begin("read only", (own) => own`select 1 as a`)).length, 1);
await check("postgres.js: unsafe", async () => (await sql.unsafe("select 1 as a; select 2 as b")).length, 2);
await check("postgres.js: describe", async () => (await sql`select pair_id from pairs where pair_id = ${1}`.describe()).types.length, 1);
await sql.end();

const query = knex({ client: "pg", connection: url, pool: { min: 0, max: 2 } });
await check("knex: select", async () => (await query("pairs").select("*").where("pair_id", "<", 5).limit(2).offset(1)).length, 2);
await check("knex: first", async () => (await query("pairs").first("pair_id").orderBy("pair_id")).pair_id, 0);
await check("knex: whereIn", async () => (await query("pairs").whereIn("pair_id", [1, 2])).length, 2);
await check("knex: count", async () => (await query("runs").count({ n: "*" })).length, 1);
await check("knex: hasTable", () => query.schema.hasTable("pairs"), true);
await check("knex: hasColumn", () => query.schema.hasColumn("pairs", "pair_id"), true);
await check("knex: columnInfo", async () => (await query("pairs").columnInfo()).pair_id.type, "integer");
await check("knex: transaction", async () => (await query.transaction((own) => own("runs").select("*"))).length > 0, true);
await query.destroy();
