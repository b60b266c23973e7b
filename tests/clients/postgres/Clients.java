import java.nio.file.Files;
import java.nio.file.Path;
import java.sql.Array;
import java.sql.Connection;
import java.sql.DatabaseMetaData;
import java.sql.DriverManager;
import java.sql.PreparedStatement;
import java.sql.ResultSet;
import java.sql.ResultSetMetaData;
import java.sql.Statement;
import java.sql.Timestamp;
import java.time.OffsetDateTime;
import java.util.Objects;

/** Checks a server with pgjdbc: given are the URL and a file of queries, printed are a JSON object per check, and of the queries the columns, the rows and the end. */
public class Clients {
    static final int FETCHED_ROWS = 100;

    interface Act {
        Object run() throws Exception;
    }

    static void check(String name, Object expected, Act act) {
        String error = null;
        try {
            Object value = act.run();
            if (expected != null && !Objects.equals(String.valueOf(value), String.valueOf(expected))) {
                error = "returned " + value;
            }
        } catch (Exception e) {
            error = String.valueOf(e.getMessage());
        }
        System.out.println("{\"check\": " + quote(name) + (error == null ? "" : ", \"error\": " + quote(error)) + "}");
    }

    static String quote(String text) {
        StringBuilder quoted = new StringBuilder("\"");
        for (char c : text.toCharArray()) {
            quoted.append(c == '"' || c == '\\' ? "\\" + c : c < ' ' ? " " : String.valueOf(c));
        }
        return quoted.append('"').toString();
    }

    static Object one(Connection lake, String sql, Object... values) throws Exception {
        try (PreparedStatement statement = lake.prepareStatement(sql)) {
            for (int i = 0; i < values.length; i++) {
                statement.setObject(i + 1, values[i]);
            }
            try (ResultSet rows = statement.executeQuery()) {
                rows.next();
                return rows.getObject(1);
            }
        }
    }

    static int count(ResultSet rows) throws Exception {
        int count = 0;
        int columns = rows.getMetaData().getColumnCount();
        for (; rows.next(); count++) {
            for (int i = 1; i <= columns; i++) {
                rows.getObject(i);
            }
        }
        rows.close();
        return count;
    }

    static void printTable(Connection lake, String table, String sql) throws Exception {
        try (Statement statement = lake.createStatement()) {
            statement.setFetchSize(FETCHED_ROWS);
            try (ResultSet rows = statement.executeQuery(sql)) {
                ResultSetMetaData about = rows.getMetaData();
                StringBuilder columns = new StringBuilder();
                for (int i = 1; i <= about.getColumnCount(); i++) {
                    columns.append(i > 1 ? ", " : "").append("[" + quote(about.getColumnName(i)) + ", " + quote(about.getColumnTypeName(i)) + "]");
                }
                System.out.println("{\"table\": " + quote(table) + ", \"columns\": [" + columns + "]}");
                while (rows.next()) {
                    System.out.println("{\"row\": [" + row(rows, about) + "]}");
                }
            }
        }
    }

    static String row(ResultSet rows, ResultSetMetaData about) throws Exception {
        StringBuilder values = new StringBuilder();
        for (int i = 1; i <= about.getColumnCount(); i++) {
            boolean isTime = about.getColumnTypeName(i).equals("timestamptz");
            values.append(i > 1 ? ", " : "").append(json(isTime ? rows.getObject(i, OffsetDateTime.class) : rows.getObject(i)));
        }
        return values.toString();
    }

    static String json(Object value) throws Exception {
        if (value == null) {
            return "null";
        }
        if (!(value instanceof Array list)) {
            return quote(String.valueOf(value));
        }
        StringBuilder items = new StringBuilder("[");
        for (Object item : (Object[]) list.getArray()) {
            items.append(items.length() > 1 ? ", " : "").append(json(item));
        }
        return items.append("]").toString();
    }

    public static void main(String[] arguments) throws Exception {
        String url = arguments[0];
        try (Connection lake = DriverManager.getConnection(url)) {
            check("select 1", 1, () -> one(lake, "select 1"));
            check("select 1, 1", 1, () -> one(lake, "select 1, 1"));
            check("int", 7, () -> one(lake, "select ?::int", 7));
            check("a value", 5, () -> one(lake, "select count(*) from pairs where pair_id < ?", 5));
            check("limit", 2, () -> one(lake, "select pair_id from pairs order by 1 limit ? offset ?", 1, 2));
            check("text", "a", () -> one(lake, "select ?::text", "a"));
            check("boolean", true, () -> one(lake, "select ?::boolean", true));
            check("double", 0.5, () -> one(lake, "select ?::float8", 0.5));
            check("a time", new Timestamp(0), () -> one(lake, "select ?::timestamptz", new Timestamp(0)));
            check("any", 2, () -> one(lake, "select count(*) from pairs where pair_id = any(?)", lake.createArrayOf("int4", new Object[] {1, 2})));
            check("array", "class [Ljava.lang.Float;", () -> {
                try (Statement s = lake.createStatement(); ResultSet rows = s.executeQuery("select ir from measurements limit 1")) {
                    rows.next();
                    return rows.getArray(1).getArray().getClass();
                }
            });
            check("often, then binary", 45, () -> {
                int sum = 0;
                try (PreparedStatement s = lake.prepareStatement("select pair_id from pairs where pair_id = ?")) {
                    for (int i = 0; i < 10; i++) {
                        s.setInt(1, i);
                        ResultSet rows = s.executeQuery();
                        rows.next();
                        sum += rows.getInt(1);
                    }
                }
                return sum;
            });
            check("fetch size", 40, () -> {
                lake.setAutoCommit(false);
                try (Statement s = lake.createStatement()) {
                    s.setFetchSize(7);
                    return count(s.executeQuery("select * from pairs limit 40"));
                } finally {
                    lake.rollback();
                    lake.setAutoCommit(true);
                }
            });
            check("max rows", 4, () -> {
                try (Statement s = lake.createStatement()) {
                    s.setMaxRows(4);
                    return count(s.executeQuery("select * from pairs"));
                }
            });
            check("interval", null, () -> one(lake, "select interval '90 minutes'"));
            check("numeric", "1.25", () -> one(lake, "select 1.25::numeric(8,2)"));
            check("isValid", true, () -> lake.isValid(5));
            check("read only", null, () -> {
                lake.setReadOnly(true);
                return 0;
            });
            check("getSchema", "public", lake::getSchema);
            check("getTransactionIsolation", null, lake::getTransactionIsolation);
            check("parameter metadata", "int4", () -> lake.prepareStatement("select * from pairs where pair_id = ?").getParameterMetaData().getParameterTypeName(1));
            check("metadata of columns", "int4", () -> lake.prepareStatement("select pair_id from pairs").getMetaData().getColumnTypeName(1));
            check("table of a column", null, () -> {
                try (Statement s = lake.createStatement(); ResultSet rows = s.executeQuery("select pair_id from pairs limit 1")) {
                    return rows.getMetaData().isNullable(1) + " " + rows.getMetaData().isAutoIncrement(1);
                }
            });
            check("copy", 4L, () -> lake.unwrap(org.postgresql.PGConnection.class).getCopyAPI()
                .copyOut("copy (select pair_id from pairs limit 4) to stdout", new java.io.StringWriter()));
            DatabaseMetaData about = lake.getMetaData();
            check("getTables", "1", () -> count(about.getTables(null, "public", "pairs", new String[] {"TABLE"})));
            check("getTables of views", true, () -> count(about.getTables(null, "public", "%", new String[] {"VIEW"})) > 0);
            check("getTables: remarks", true, () -> {
                ResultSet rows = about.getTables(null, "public", "pairs", null);
                rows.next();
                return rows.getString("REMARKS") != null;
            });
            check("getColumns", true, () -> count(about.getColumns(null, "public", "pairs", "%")) > 3);
            check("getColumns of all", true, () -> count(about.getColumns(null, "public", "%", "%")) > 50);
            check("getColumns: type of a list", "_float4", () -> {
                ResultSet rows = about.getColumns(null, "public", "measurements", "ir");
                rows.next();
                return rows.getString("TYPE_NAME");
            });
            check("getPrimaryKeys", 0, () -> count(about.getPrimaryKeys(null, "public", "pairs")));
            check("getImportedKeys", 0, () -> count(about.getImportedKeys(null, "public", "pairs")));
            check("getExportedKeys", 0, () -> count(about.getExportedKeys(null, "public", "pairs")));
            check("getCrossReference", 0, () -> count(about.getCrossReference(null, "public", "pairs", null, "public", "runs")));
            check("getIndexInfo", 0, () -> count(about.getIndexInfo(null, "public", "pairs", false, false)));
            check("getBestRowIdentifier", 0, () -> count(about.getBestRowIdentifier(null, "public", "pairs", 0, true)));
            check("getVersionColumns", null, () -> count(about.getVersionColumns(null, "public", "pairs")));
            check("getSchemas", true, () -> count(about.getSchemas()) > 1);
            check("getCatalogs", true, () -> count(about.getCatalogs()) > 0);
            check("getTableTypes", true, () -> count(about.getTableTypes()) > 0);
            check("getTypeInfo", true, () -> count(about.getTypeInfo()) > 10);
            check("getFunctions", null, () -> count(about.getFunctions(null, "public", "%")));
            check("getFunctionColumns", null, () -> count(about.getFunctionColumns(null, "public", "%", "%")));
            check("getProcedures", null, () -> count(about.getProcedures(null, "public", "%")));
            check("getProcedureColumns", null, () -> count(about.getProcedureColumns(null, "public", "%", "%")));
            check("getTablePrivileges", null, () -> count(about.getTablePrivileges(null, "public", "pairs")));
            check("getColumnPrivileges", null, () -> count(about.getColumnPrivileges(null, "public", "pairs", "%")));
            check("getUDTs", 0, () -> count(about.getUDTs(null, "public", "%", null)));
            check("getClientInfoProperties", null, () -> count(about.getClientInfoProperties()));
            check("getSQLKeywords", null, about::getSQLKeywords);
            check("getMaxColumnNameLength", 63, about::getMaxColumnNameLength);
            check("getMaxColumnsInIndex", 32, about::getMaxColumnsInIndex);
            check("getDatabaseProductName", "PostgreSQL", about::getDatabaseProductName);
            // Drivers stream within transactions alone.
            lake.setAutoCommit(false);
            for (String line : Files.readAllLines(Path.of(arguments[1]))) {
                String[] parts = line.split("\t", 2);
                String error = "";
                try {
                    printTable(lake, parts[0], parts[1]);
                } catch (Exception e) {
                    lake.rollback();
                    error = ", \"error\": " + quote(String.valueOf(e.getMessage()));
                }
                System.out.println("{\"end\": " + quote(parts[0]) + error + "}");
            }
        }
    }
}
