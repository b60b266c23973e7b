// Checks a server with Node's clients of Postgres: `clients.mjs URL QUERIES` prints a JSON object per check, with `error` if it
// failed, and of the file's queries the columns, the rows and the end.
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
const TIME = 1184;
const types = { getTypeParser: (number, format) => (number === TIME ? String : pg.types.getTypeParser(number, format)) };
const FETCHED_ROWS = 100;
const printable = (value) => (value === null ? null : Array.isArray(value) ? value.map(printable) : Buffer.isBuffer(value) ? value.toString("hex") : String(value));
const print = (line) => console.log(JSON.stringify(line));

// Prints a query's columns, rows and end; `fetch` calls back with the columns and each part of the rows.
async function printTable(driver, table, fetch) {
  let columns;
  try {
    await fetch((names, rows) => {
      if (!columns) print({ driver, table, columns: (columns = names) });
      for (const row of rows) print({ row: row.map(printable) });
    });
    print({ driver, end: table });
  } catch (error) {
    print({ driver, end: table, error: String(error.message ?? error).slice(0, 600) });
  }
}

const queries = readFileSync(process.argv[3], "utf8").trim().split("\n").map((line) => line.split("\t"));
for (const [table, text] of queries) {
  await printTable("pg", table, async (take) => {
    const cursor = client.query(new Cursor(text, [], { rowMode: "array", types }));
    const read = () => new Promise((resolve, reject) => cursor.read(FETCHED_ROWS, (error, rows, result) => (error ? reject(error) : resolve([rows, result]))));
    for (let [rows, result] = await read(); rows.length > 0; [rows, result] = await read()) {
      take(result.fields.map((field) => [field.name, String(field.dataTypeID)]), rows);
    }
  });
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

const plain = postgres(url, { max: 1, onnotice: () => {}, types: { time: { to: TIME, from: [TIME], serialize: String, parse: String } } });
for (const [table, text] of queries) {
  await printTable("postgres.js", table, async (take) => {
    let columns;
    for await (const rows of plain.unsafe(text).cursor(FETCHED_ROWS)) {
      columns ??= rows.columns;
      take(columns.map((column) => [column.name, String(column.type)]), rows.map((row) => columns.map((column) => row[column.name])));
    }
  });
}
await plain.end();

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
