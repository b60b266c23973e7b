// The checks of pgx 4: its own interface, its pool, and Go's database/sql over it.
package main

import (
	"bytes"
	"context"
	"database/sql"
	"errors"
	"fmt"
	"time"

	"github.com/jackc/pgconn"
	"github.com/jackc/pgproto3/v2"
	"github.com/jackc/pgtype"
	"github.com/jackc/pgx/v4"
	"github.com/jackc/pgx/v4/pgxpool"
	_ "github.com/jackc/pgx/v4/stdlib"
)

func runChecks(url string) (func(string) (tableRows, error), error) {
	always := context.Background()
	lake, err := pgx.Connect(always, url)
	if err != nil {
		return nil, err
	}
	one := func(query string, values ...interface{}) func() (interface{}, error) {
		return func() (interface{}, error) { return oneValue(lake.Query(always, query, values...)) }
	}
	check("ping", nil, func() (interface{}, error) { return nil, lake.Ping(always) })
	check("select", 1, one("select 1"))
	check("select 1, 1", 1, one("select 1, 1"))
	check("a value", 5, one("select count(*) from pairs where pair_id < $1", 5))
	check("a cast", 7, one("select $1::int", 7))
	check("bigint", 8, one("select $1::bigint + 1", 7))
	check("a text", "é", one("select $1::text", "é"))
	check("boolean", true, one("select $1::boolean", true))
	check("float", 0.25, one("select $1::float8", 0.25))
	check("limit", 2, one("select pair_id from pairs order by 1 limit $1 offset $2", 1, 2))
	check("any", 2, one("select count(*) from pairs where pair_id = any($1)", []int32{1, 2}))
	check("any of a cast", 2, one("select count(*) from pairs where pair_id = any($1::int[])", []int32{1, 2}))
	check("any of texts", 0, one("select count(*) from runs where run_id = any($1)", []string{"x"}))
	check("like with escape", 0, one("select count(*) from pg_class where relname like $1 escape '/'", "nce/%"))
	check("null", true, func() (interface{}, error) {
		var got *int32
		err := lake.QueryRow(always, "select $1::int", nil).Scan(&got)
		return got == nil, err
	})
	check("a time", true, func() (interface{}, error) {
		var got time.Time
		err := lake.QueryRow(always, "select $1::timestamptz", time.Unix(0, 0)).Scan(&got)
		return got.Unix() == 0, err
	})
	check("a date", true, func() (interface{}, error) {
		var got time.Time
		err := lake.QueryRow(always, "select $1::date", time.Unix(86400, 0).UTC()).Scan(&got)
		return got.Unix() == 86400, err
	})
	check("an interval", 90*60*1000000, func() (interface{}, error) {
		var got pgtype.Interval
		err := lake.QueryRow(always, "select interval '90 minutes'").Scan(&got)
		return got.Microseconds, err
	})
	check("a numeric", 1.25, func() (interface{}, error) {
		var got float64
		err := lake.QueryRow(always, "select 1.25::numeric(8,2)").Scan(&got)
		return got, err
	})
	check("a list", true, func() (interface{}, error) {
		var got []float32
		err := lake.QueryRow(always, "select ir from measurements limit 1").Scan(&got)
		return len(got) > 0, err
	})
	check("simple protocol", 5, one("select count(*) from pairs where pair_id < $1", pgx.QuerySimpleProtocol(true), 5))
	check("prepared", 3, func() (interface{}, error) {
		if _, err := lake.Prepare(always, "by_pair", "select pair_id from pairs where pair_id = $1"); err != nil {
			return nil, err
		}
		var sum, got int
		for pair := 0; pair < 3; pair++ {
			if err := lake.QueryRow(always, "by_pair", pair).Scan(&got); err != nil {
				return nil, err
			}
			sum += got
		}
		return sum, lake.Deallocate(always, "by_pair")
	})
	check("described", "[23] [int4 float8]", func() (interface{}, error) {
		about, err := lake.Prepare(always, "described", "select pair_id, direct_mm from pairs where pair_id = $1")
		if err != nil {
			return nil, err
		}
		return fmt.Sprint(about.ParamOIDs, " ", typeNames(lake, about.Fields)), nil
	})
	check("batch", 6, func() (interface{}, error) {
		batch := &pgx.Batch{}
		for pair := 1; pair <= 3; pair++ {
			batch.Queue("select pair_id from pairs where pair_id = $1", pair)
		}
		answers := lake.SendBatch(always, batch)
		defer answers.Close()
		var sum, got int
		for pair := 1; pair <= 3; pair++ {
			if err := answers.QueryRow().Scan(&got); err != nil {
				return nil, err
			}
			sum += got
		}
		return sum, nil
	})
	check("copy", 4, func() (interface{}, error) {
		var text bytes.Buffer
		_, err := lake.PgConn().CopyTo(always, &text, "copy (select pair_id from pairs limit 4) to stdout")
		return bytes.Count(text.Bytes(), []byte("\n")), err
	})
	check("transaction", nil, func() (interface{}, error) {
		own, err := lake.BeginTx(always, pgx.TxOptions{AccessMode: pgx.ReadOnly})
		if err != nil {
			return nil, err
		}
		if _, err = own.Exec(always, "select 1"); err != nil {
			return nil, err
		}
		return nil, own.Commit(always)
	})
	check("an error's code", "42P01", func() (interface{}, error) {
		var failed *pgconn.PgError
		if _, err := lake.Exec(always, "select * from nope"); !errors.As(err, &failed) {
			return nil, err
		}
		return failed.Code, nil
	})
	check("cancel", "57014", func() (interface{}, error) {
		soon, cancel := context.WithTimeout(always, 500*time.Millisecond)
		defer cancel()
		own, err := pgx.Connect(always, url)
		if err != nil {
			return nil, err
		}
		defer own.Close(always)
		go func() {
			<-soon.Done()
			own.PgConn().CancelRequest(always)
		}()
		var failed *pgconn.PgError
		_, err = own.Exec(always, "select count(*) from generate_series(1, 4000000000) a(x) where x % 7 = 8")
		if !errors.As(err, &failed) {
			return nil, err
		}
		return failed.Code, nil
	})
	check("pool", 6, func() (interface{}, error) {
		pool, err := pgxpool.Connect(always, url+"&pool_max_conns=2")
		if err != nil {
			return nil, err
		}
		defer pool.Close()
		var sum, got int
		for number := 1; number <= 3; number++ {
			if err := pool.QueryRow(always, "select $1::int", number).Scan(&got); err != nil {
				return nil, err
			}
			sum += got
		}
		return sum, nil
	})
	check("database/sql", "5 INT8", func() (interface{}, error) {
		standard, err := sql.Open("pgx", url)
		if err != nil {
			return nil, err
		}
		defer standard.Close()
		rows, err := standard.Query("select count(*) from pairs where pair_id < $1", 5)
		if err != nil {
			return nil, err
		}
		defer rows.Close()
		types, err := rows.ColumnTypes()
		if err != nil || !rows.Next() {
			return nil, err
		}
		var got int64
		err = rows.Scan(&got)
		return fmt.Sprint(got, " ", types[0].DatabaseTypeName()), err
	})
	return func(query string) (tableRows, error) {
		rows, err := lake.Query(always, query)
		return &ownRows{lake, rows}, err
	}, nil
}

func oneValue(rows pgx.Rows, err error) (interface{}, error) {
	if err != nil {
		return nil, err
	}
	defer rows.Close()
	if !rows.Next() {
		return nil, rows.Err()
	}
	values, err := rows.Values()
	if err != nil {
		return nil, err
	}
	return values[0], nil
}

func typeNames(lake *pgx.Conn, fields []pgproto3.FieldDescription) (names []string) {
	for _, field := range fields {
		kind, known := lake.ConnInfo().DataTypeForOID(field.DataTypeOID)
		if !known {
			kind = &pgtype.DataType{Name: fmt.Sprint(field.DataTypeOID)}
		}
		names = append(names, kind.Name)
	}
	return names
}

type ownRows struct {
	lake *pgx.Conn
	rows pgx.Rows
}

func (answer *ownRows) columns() (columns [][]string) {
	fields := answer.rows.FieldDescriptions()
	for i, name := range typeNames(answer.lake, fields) {
		columns = append(columns, []string{string(fields[i].Name), name})
	}
	return columns
}

func (answer *ownRows) next() ([]interface{}, error) {
	if !answer.rows.Next() {
		return nil, answer.rows.Err()
	}
	values, err := answer.rows.Values()
	for i := range values {
		if list, ok := values[i].(interface{ Get() interface{} }); ok {
			values[i] = list.Get()
		}
		values[i] = plainList(values[i])
	}
	return values, err
}

// A list of numbers, texts or nothing as values.
func plainList(value interface{}) interface{} {
	items := []interface{}{}
	switch list := value.(type) {
	case pgtype.Float4Array:
		for _, item := range list.Elements {
			items = append(items, item.Get())
		}
	case pgtype.Float8Array:
		for _, item := range list.Elements {
			items = append(items, item.Get())
		}
	case pgtype.Int4Array:
		for _, item := range list.Elements {
			items = append(items, item.Get())
		}
	case pgtype.Int8Array:
		for _, item := range list.Elements {
			items = append(items, item.Get())
		}
	case pgtype.TextArray:
		for _, item := range list.Elements {
			items = append(items, item.Get())
		}
	default:
		return value
	}
	return items
}

func (answer *ownRows) close() {
	answer.rows.Close()
}
