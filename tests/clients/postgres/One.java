import java.sql.Connection;
import java.sql.DriverManager;
import java.sql.ResultSet;
import java.sql.Statement;

/** Prints the one value of a query: given are the URL and the query. */
public class One {
    public static void main(String[] arguments) throws Exception {
        try (Connection lake = DriverManager.getConnection(arguments[0]); Statement statement = lake.createStatement()) {
            try (ResultSet rows = statement.executeQuery(arguments[1])) {
                rows.next();
                System.out.println(rows.getString(1));
            }
        }
    }
}
