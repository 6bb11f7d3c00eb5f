# Draws the cost of a series against its error: gnuplot -e "data='FILE'; picture='FILE'" trade-series.gp
# Columns of the data, apart by tabs: dataset, precision, accuracy, ns of an evaluation, largest relative error,
# ln(1/eps) of "dial".

set terminal svg size 900,520 font 'sans-serif,13' background '#ffffff'
set output picture
set datafile separator '\t'

set tics out nomirror font ',11'
set border 3
set grid xtics ytics linecolor '#dddddd'
set logscale y
set format y '10^{%T}'
set yrange [1e-17:1e-1]
set xrange [0:*]
set xlabel 'ns of an evaluation, one core' font ',12'
set ylabel 'largest relative error of f' font ',12'
set key outside right top font ',11' noenhanced
set title "He-Torrance at the fitted parameters\nlines: double, series summed to an eps from e^{-6} to e^{-34}" font ',13'

datasets = system(sprintf("cut -f1 %s | sort -u | tr '\\n' ' '", data))
colours = '#2171b5 #d95f02 #238b45 #6a51a3 #cb181d #525252'
colour(i) = word(colours, 1 + (i - 1) % words(colours))
rows(d, condition) = sprintf("< awk -F'\\t' '$1 == \"%s\" && %s' %s", d, condition, data)

plot for [i = 1:words(datasets)] rows(word(datasets, i), '$3 == "dial"') using 4:5 with linespoints pointtype 7 \
        pointsize 0.6 linewidth 1.5 linecolor rgb colour(i) title word(datasets, i), \
    for [i = 1:words(datasets)] rows(word(datasets, i), '$2 == "double" && $3 != "dial"') using 4:5 with points \
        pointtype 4 pointsize 1 linewidth 1.5 linecolor rgb colour(i) title (i == 1 ? 'double: full, search' : ''), \
    for [i = 1:words(datasets)] rows(word(datasets, i), '$2 == "single"') using 4:5 with points \
        pointtype 8 pointsize 1.1 linewidth 1.5 linecolor rgb colour(i) title (i == 1 ? 'single: full, search' : '')
