// The checks of lib/pq, by Go's database/sql.
package main

import (
	"database/sql"
	"strings"
	"time"

	"github.com/lib/pq"
)

func runChecks(url string) (func(string) (tableRows, error), error) {
	lake, err := sql.Open("postgres", url)
	if err != nil {
		return nil, err
	}
	one := func(query string, values ...interface{}) func() (interface{}, error) {
		return func() (value interface{}, err error) {
			err = lake.QueryRow(query, values...).Scan(&value)
			return value, err
		}
	}
	check("ping", nil, func() (interface{}, error) { return nil, lake.Ping() })
	check("select", 1, one("select 1"))
	check("a value", 5, one("select count(*) from pairs where pair_id < $1", 5))
	check("a cast", 7, one("select $1::int", 7))
	check("a text", "a", one("select $1::text::text", "a"))
	check("boolean", true, one("select $1::boolean", true))
	check("float", 0.5, one("select $1::float8", 0.5))
	check("limit", 2, one("select pair_id from pairs order by 1 limit $1 offset $2", 1, 2))
	check("any", 2, one("select count(*) from pairs where pair_id = any($1)", pq.Array([]int64{1, 2})))
	check("any of a cast", 2, one("select count(*) from pairs where pair_id = any($1::int[])", pq.Array([]int64{1, 2})))
	check("any of texts", 0, one("select count(*) from runs where run_id = any($1)", pq.Array([]string{"x"})))
	check("a time", true, func() (interface{}, error) {
		var got time.Time
		err := lake.QueryRow("select $1::timestamptz", time.Unix(0, 0)).Scan(&got)
		return got.Unix() == 0, err
	})
	check("a list", true, func() (interface{}, error) {
		var ir pq.Float64Array
		err := lake.QueryRow("select ir from measurements limit 1").Scan(&ir)
		return len(ir) > 0, err
	})
	check("null", true, func() (interface{}, error) {
		var got sql.NullInt64
		err := lake.QueryRow("select $1::int", nil).Scan(&got)
		return !got.Valid, err
	})
	check("prepared", 3, func() (interface{}, error) {
		statement, err := lake.Prepare("select pair_id from pairs where pair_id = $1")
		if err != nil {
			return nil, err
		}
		defer statement.Close()
		var sum, got int
		for pair := 0; pair < 3; pair++ {
			if err = statement.QueryRow(pair).Scan(&got); err != nil {
				return nil, err
			}
			sum += got
		}
		return sum, nil
	})
	check("column types", "INT4", func() (interface{}, error) {
		rows, err := lake.Query("select pair_id from pairs limit 1")
		if err != nil {
			return nil, err
		}
		defer rows.Close()
		types, err := rows.ColumnTypes()
		return types[0].DatabaseTypeName(), err
	})
	check("transaction", nil, func() (interface{}, error) {
		own, err := lake.Begin()
		if err != nil {
			return nil, err
		}
		if _, err = own.Exec("select 1"); err != nil {
			return nil, err
		}
		return nil, own.Commit()
	})
	check("an error's code", "42P01", func() (interface{}, error) {
		_, err := lake.Exec("select * from nope")
		return err.(*pq.Error).Code, nil
	})
	return func(query string) (tableRows, error) {
		rows, err := lake.Query(query)
		if err != nil {
			return nil, err
		}
		types, err := rows.ColumnTypes()
		return &driverRows{rows, types}, err
	}, nil
}

type driverRows struct {
	rows  *sql.Rows
	types []*sql.ColumnType
}

func (answer *driverRows) columns() (columns [][]string) {
	for _, kind := range answer.types {
		columns = append(columns, []string{kind.Name(), kind.DatabaseTypeName()})
	}
	return columns
}

func (answer *driverRows) next() ([]interface{}, error) {
	if !answer.rows.Next() {
		return nil, answer.rows.Err()
	}
	values := make([]interface{}, len(answer.types))
	places := make([]interface{}, len(answer.types))
	for i, kind := range answer.types {
		places[i] = &values[i]
		if strings.HasPrefix(kind.DatabaseTypeName(), "_") {
			values[i] = &[]sql.NullString{}
			places[i] = pq.Array(values[i])
		}
	}
	if err := answer.rows.Scan(places...); err != nil {
		return nil, err
	}
	for i := range values {
		if list, ok := values[i].(*[]sql.NullString); ok {
			values[i] = items(*list)
		}
	}
	return values, nil
}

func (answer *driverRows) close() {
	answer.rows.Close()
}

func items(list []sql.NullString) interface{} {
	items := []interface{}{}
	for _, item := range list {
		if item.Valid {
			items = append(items, item.String)
		} else {
			items = append(items, nil)
		}
	}
	return items
}
