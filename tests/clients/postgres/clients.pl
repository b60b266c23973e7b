# Checks a server with Perl's DBD::Pg: `clients.pl HOST PORT USER DATABASE QUERIES` prints a JSON object per check,
# and of the file's queries the columns, the rows and the end.
use strict;
use warnings;
use DBI;
use JSON::PP;

my ($host, $port, $user, $database, $queries) = @ARGV;
my $dbh = DBI->connect("dbi:Pg:host=$host;port=$port;dbname=$database", $user, '', { RaiseError => 1, PrintError => 0 });

$| = 1;
$dbh->do(q{set statement_timeout = '20s'});

sub check {
    my ($name, $act, $expected) = @_;
    my $value = eval { $act->() };
    my %line = (check => $name);
    if ($@) { $line{error} = "$@" }
    elsif (defined $expected && (!defined $value || $value ne $expected)) { $line{error} = 'returned ' . ($value // 'NULL') }
    print encode_json(\%line), "\n";
}

sub one { return ($dbh->selectrow_array($_[0], undef, @_[1 .. $#_]))[0] }

check('select', sub { one('select 1') }, 1);
check('select 1, 1', sub { scalar(my @row = $dbh->selectrow_array('select 1, 1')) }, 2);
check('a value', sub { one('select count(*) from pairs where pair_id < ?', 5) }, 5);
check('a cast', sub { one('select ?::int', 7) }, 7);
check('a text', sub { one('select ?::text', 'a') }, 'a');
check('limit', sub { one('select pair_id from pairs order by 1 limit ? offset ?', 1, 2) }, 2);
check('any', sub { one('select count(*) from pairs where pair_id = any(?)', [ 1, 2 ]) }, 2);
check('a list', sub { ref(one('select ir from measurements limit 1')) }, 'ARRAY');
check('ping', sub { $dbh->ping ? 1 : 0 }, 1);
check('prepared', sub {
    my $statement = $dbh->prepare('select pair_id from pairs where pair_id = ?');
    my $sum = 0;
    for my $pair (1 .. 4) { $statement->execute($pair); $sum += ($statement->fetchrow_array)[0] }
    return $sum;
}, 10);
check('types', sub { my $s = $dbh->prepare('select pair_id, direct_mm from pairs limit 1'); $s->execute; join ',', @{ $s->{pg_type} } }, 'int4,float8');
check('table_info', sub { scalar(@{ $dbh->table_info(undef, 'public', 'pairs', 'TABLE')->fetchall_arrayref }) }, 1);
check('table_info of views', sub { @{ $dbh->table_info(undef, 'public', '%', 'VIEW')->fetchall_arrayref } > 0 ? 1 : 0 }, 1);
check('table_info of schemas', sub { @{ $dbh->table_info('', '%', '')->fetchall_arrayref } > 0 ? 1 : 0 }, 1);
check('column_info', sub { $dbh->column_info(undef, 'public', 'pairs', 'pair_id')->fetchall_arrayref->[0][5] }, 'integer');
check('column_info of all', sub { @{ $dbh->column_info(undef, 'public', '%', '%')->fetchall_arrayref } > 50 ? 1 : 0 }, 1);
check('primary_key_info', sub { my $s = $dbh->primary_key_info(undef, 'public', 'pairs'); $s ? scalar(@{ $s->fetchall_arrayref }) : 0 }, 0);
check('foreign_key_info', sub { my $s = $dbh->foreign_key_info(undef, 'public', 'pairs', undef, undef, undef); $s ? scalar(@{ $s->fetchall_arrayref }) : 0 }, 0);
check('statistics_info', sub { my $s = $dbh->statistics_info(undef, 'public', 'pairs', 0, 0); $s ? 1 : 0 }, 1);
check('type_info_all', sub { @{ $dbh->type_info_all } > 3 ? 1 : 0 }, 1);
check('tables', sub { my @all = $dbh->tables(undef, 'public', undef, 'TABLE'); @all > 3 ? 1 : 0 }, 1);
check('pg_server_version', sub { $dbh->{pg_server_version} > 90000 ? 1 : 0 }, 1);
check('pg_pid', sub { one('select pg_backend_pid()') == $dbh->{pg_pid} ? 1 : 0 }, 1);
check('transaction', sub { $dbh->begin_work; my $n = one('select 1'); $dbh->rollback; $n }, 1);
check('copy', sub {
    $dbh->do('copy (select pair_id from pairs limit 3) to stdout');
    my ($count, $line) = (0, '');
    $count++ while $dbh->pg_getcopydata($line) >= 0;
    return $count;
}, 3);
open(my $file, '<', $queries) or die "$queries: $!";
while (my $line = <$file>) {
    chomp $line;
    my ($table, $sql) = split /\t/, $line, 2;
    my %end = (end => $table);
    eval {
        my $statement = $dbh->prepare($sql);
        $statement->execute;
        my ($names, $types) = ($statement->{NAME}, $statement->{pg_type});
        print encode_json({ table => $table, columns => [ map { [ $names->[$_], $types->[$_] ] } 0 .. $#$names ] }), "\n";
        while (my $row = $statement->fetchrow_arrayref) {
            print encode_json({ row => [ map { printable($row->[$_], $types->[$_]) } 0 .. $#$row ] }), "\n";
        }
        1;
    } or $end{error} = "$@";
    print encode_json(\%end), "\n";
}
$dbh->disconnect;

sub printable {
    my ($value, $type) = @_;
    return undef unless defined $value;
    return [ map { printable($_, $type) } @$value ] if ref $value;
    # Perl prints numbers with fifteen digits.
    return $type =~ /float/ ? sprintf('%.17g', $value) : "$value";
}
