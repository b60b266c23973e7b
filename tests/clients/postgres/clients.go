// Checks a server with a client of Go, whose file is built with this one: lib_pq.go or pgx.go. Given are the URL and a file
// of queries, printed are a JSON object per check, and of the queries the columns, the rows and the end.
package main

import (
	"encoding/hex"
	"encoding/json"
	"fmt"
	"os"
	"strings"
	"time"
)

// A query's rows: their columns with types, and the values of one after the other, nil behind the last.
type tableRows interface {
	columns() [][]string
	next() ([]interface{}, error)
	close()
}

// Prints a line.
func print(line map[string]interface{}) {
	text, err := json.Marshal(line)
	if err != nil {
		panic(err)
	}
	fmt.Println(string(text))
}

func check(name string, expected interface{}, act func() (interface{}, error)) {
	line := map[string]interface{}{"check": name}
	value, err := act()
	if err != nil {
		line["error"] = err.Error()
	} else if expected != nil && fmt.Sprint(value) != fmt.Sprint(expected) {
		line["error"] = fmt.Sprintf("returned %v", value)
	}
	print(line)
}

func main() {
	query, err := runChecks(os.Args[1])
	if err != nil {
		panic(err)
	}
	queries, err := os.ReadFile(os.Args[2])
	if err != nil {
		panic(err)
	}
	for _, line := range strings.Split(strings.TrimSpace(string(queries)), "\n") {
		parts := strings.SplitN(line, "\t", 2)
		end := map[string]interface{}{"end": parts[0]}
		if err := printTable(parts[0], parts[1], query); err != nil {
			end["error"] = err.Error()
		}
		print(end)
	}
}

func printTable(table, query string, ask func(string) (tableRows, error)) error {
	rows, err := ask(query)
	if err != nil {
		return err
	}
	defer rows.close()
	print(map[string]interface{}{"table": table, "columns": rows.columns()})
	for {
		values, err := rows.next()
		if values == nil || err != nil {
			return err
		}
		for i := range values {
			values[i] = printable(values[i])
		}
		print(map[string]interface{}{"row": values})
	}
}

func printable(value interface{}) interface{} {
	switch value := value.(type) {
	case nil:
		return nil
	case []interface{}:
		for i := range value {
			value[i] = printable(value[i])
		}
		return value
	case time.Time:
		return value.UTC().Format(time.RFC3339Nano)
	case []byte:
		return hex.EncodeToString(value)
	default:
		return fmt.Sprint(value)
	}
}
