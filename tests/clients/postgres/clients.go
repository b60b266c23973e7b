// Checks a server with Go's lib/pq: given are the URL and a file of queries, printed are a JSON object per check and per
// query.
package main

import (
	"database/sql"
	"encoding/hex"
	"encoding/json"
	"fmt"
	"os"
	"strings"
	"time"

	"github.com/lib/pq"
)

func check(name string, expected interface{}, act func() (interface{}, error)) {
	line := map[string]string{"check": name}
	value, err := act()
	if err != nil {
		line["error"] = err.Error()
	} else if expected != nil && fmt.Sprint(value) != fmt.Sprint(expected) {
		line["error"] = fmt.Sprintf("returned %v", value)
	}
	text, _ := json.Marshal(line)
	fmt.Println(string(text))
}

func main() {
	lake, err := sql.Open("postgres", os.Args[1])
	if err != nil {
		panic(err)
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
	queries, err := os.ReadFile(os.Args[2])
	if err != nil {
		panic(err)
	}
	for _, line := range strings.Split(strings.TrimSpace(string(queries)), "\n") {
		parts := strings.SplitN(line, "\t", 2)
		answer := map[string]interface{}{"table": parts[0]}
		if columns, rows, err := sample(lake, parts[1]); err != nil {
			answer["error"] = err.Error()
		} else {
			answer["columns"], answer["rows"] = columns, rows
		}
		text, _ := json.Marshal(answer)
		fmt.Println(string(text))
	}
}

func sample(lake *sql.DB, query string) (columns [][]string, all [][]interface{}, err error) {
	rows, err := lake.Query(query)
	if err != nil {
		return nil, nil, err
	}
	defer rows.Close()
	types, err := rows.ColumnTypes()
	if err != nil {
		return nil, nil, err
	}
	for _, kind := range types {
		columns = append(columns, []string{kind.Name(), kind.DatabaseTypeName()})
	}
	for rows.Next() {
		values := make([]interface{}, len(types))
		places := make([]interface{}, len(types))
		for i, kind := range types {
			places[i] = &values[i]
			if strings.HasPrefix(kind.DatabaseTypeName(), "_") {
				values[i] = &[]sql.NullString{}
				places[i] = pq.Array(values[i])
			}
		}
		if err = rows.Scan(places...); err != nil {
			return nil, nil, err
		}
		for i := range values {
			values[i] = printable(values[i])
		}
		all = append(all, values)
	}
	return columns, all, rows.Err()
}

func printable(value interface{}) interface{} {
	switch value := value.(type) {
	case nil:
		return nil
	case *[]sql.NullString:
		items := []interface{}{}
		for _, item := range *value {
			if item.Valid {
				items = append(items, item.String)
			} else {
				items = append(items, nil)
			}
		}
		return items
	case time.Time:
		return value.UTC().Format(time.RFC3339Nano)
	case []byte:
		return hex.EncodeToString(value)
	default:
		return fmt.Sprint(value)
	}
}
